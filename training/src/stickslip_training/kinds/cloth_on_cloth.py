"""What a batch of clips of cloth that is dragged over cloth is."""

from stickslip_training.data.clips import ClipSamples


class ClothOnClothDataset(ClipSamples):
    """Clips of cloth that is dragged over cloth.

    An item holds `video` (frames, 224, 224, 3) uint8; `material`, `substrate_material`, `texture`, `viewpoint` int64,
    the codes of categories; `mu` float32, the friction of the two; `bias_side` and `landed_side` int64; `slot` int64;
    `sample_key` uint8 (32,). With `positions`, also `positions` (300, vertices, 3) float32 [m] of the dragged cloth,
    and `rest()` and `triangles()` say what mesh it is.
    """

    kind = "cloth_on_cloth"
    labels = ("material", "substrate_material", "mu", "texture", "viewpoint", "bias_side", "landed_side")


DATASET = ClothOnClothDataset
