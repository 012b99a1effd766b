"""What a batch of rods at rest is."""

import os

from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import SampleDataset
from stickslip_training.data.version import Split


class RodDataset(SampleDataset):
    """Rods at rest.

    An item holds `centerline` (150, 3) float32, positions over L; `curvature` (150, 3) float32, (twist, bend1, bend2)
    times L; `gamma`, `phi0`, `phi1` float32; `slot` int64; `sample_key` uint8 (32,). With `frame`, also `frame`
    (150, 3, 3) float32; with `views`, also `views` (4, 224, 224, 3) uint8 and `color` (3,) float32.
    """

    kind = "rod_hang"

    def __init__(
        self,
        source: str | os.PathLike[str] | DatasetReader,
        split: Split | None = None,
        *,
        views: bool = False,
        frame: bool = False,
        ring: int = 0,
    ) -> None:
        """Open `split` of a dataset of rods, or all of it; `source` is a directory, a URL or an open reader."""
        arrays = ["centerline", "curvature"] + ["frame"] * frame + ["views"] * views
        labels = ["gamma", "phi0", "phi1"] + ["color"] * views
        super().__init__(source, split, arrays=arrays, labels=labels, ring=ring)


DATASET = RodDataset
