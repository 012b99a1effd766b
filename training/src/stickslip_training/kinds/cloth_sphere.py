"""What a batch of clips of cloth on a turning sphere is."""

from stickslip_training.data.clips import ClipSamples


class SphereDataset(ClipSamples):
    """Clips of cloth that a turning sphere drags.

    An item holds `video` (frames, 224, 224, 3) uint8; `material`, `texture`, `viewpoint` int64, the codes of
    categories; `mu` and `angular_speed` [rad/s] float32; `slot` int64; `sample_key` uint8 (32,). With `positions`, also
    `positions` (150, vertices, 3) float32 [m], and `rest()` and `triangles()` say what mesh it is.
    """

    kind = "cloth_sphere"
    labels = ("material", "mu", "angular_speed", "texture", "viewpoint")


DATASET = SphereDataset
