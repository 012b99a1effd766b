"""What a batch of clips of shawls is."""

from stickslip_training.data.clips import ClipSamples


class ShawlDataset(ClipSamples):
    """Clips of a shawl over the shoulders of a figure that moves.

    An item holds `video` (frames, 224, 224, 3) uint8; `material`, `texture`, `viewpoint` int64, the codes of
    categories; `mu` and `self_friction` float32, the friction of the shawl with the figure and with itself; `slot`
    int64; `sample_key` uint8 (32,). With `positions`, also `positions` (150, vertices, 3) float32 [m], and `rest()` and
    `triangles()` say what mesh it is.
    """

    kind = "shawl"
    labels = ("material", "mu", "self_friction", "texture", "viewpoint")


DATASET = ShawlDataset
