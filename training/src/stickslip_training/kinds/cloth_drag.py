"""What a batch of clips of dragged cloth is."""

from stickslip_training.data.clips import ClipSamples


class ClipDataset(ClipSamples):
    """Clips of dragged cloth.

    An item holds `video` (frames, 224, 224, 3) uint8; `material`, `texture`, `viewpoint` int64, the codes of
    categories: `item.name("material")` and `batch.names("material")` say which; `mu` float32; `bias_side` and
    `landed_side` int64, to which gravity leaned during the drop and where the cloth landed; `slot` int64; `sample_key`
    uint8 (32,). With `positions`, also `positions` (300, vertices, 3) float32 [m], and `rest()` and `triangles()` say
    what mesh it is.
    """

    kind = "cloth_drag"
    labels = ("material", "mu", "texture", "viewpoint", "bias_side", "landed_side")


DATASET = ClipDataset
