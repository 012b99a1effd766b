"""What the torch datasets of all kinds of cloth clips have in common."""

import os
from typing import ClassVar

import torch

from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import SampleDataset
from stickslip_training.data.version import Split


class ClipSamples(SampleDataset):
    """Clips of cloth: `video` (frames, 224, 224, 3) uint8, the labels of the kind, and on request the vertices."""

    labels: ClassVar[tuple[str, ...]]
    """The labels of an item: int64 where they are codes or counts, float32 where they are quantities."""

    def __init__(
        self,
        source: str | os.PathLike[str] | DatasetReader,
        split: Split | None = None,
        *,
        positions: bool = False,
        ring: int = 0,
    ) -> None:
        """Open `split` of a dataset of clips, or all of it; `source` is a directory, a URL or an open reader."""
        super().__init__(source, split, arrays=["video"] + ["positions"] * positions, labels=self.labels, ring=ring)

    @property
    def instants(self) -> tuple[int, ...]:
        """Index into the first dimension of `positions` of each frame of `video`."""
        return tuple(self.reader.arrays["video"].attributes["instants"])

    def rest(self) -> torch.Tensor:
        """Return the flat cloth of all samples, (vertices, 2) float32 [m]."""
        return self._of_any_sample("rest")

    def triangles(self) -> torch.Tensor:
        """Return the triangles of the mesh of all samples, (triangles, 3) int32."""
        return self._of_any_sample("triangles")

    def _of_any_sample(self, name: str) -> torch.Tensor:
        valid = self.reader.slots()
        if name not in self.reader.arrays or not len(valid):
            raise ValueError(f"the dataset has no {name}: its spec says store_positions: false, or no sample is valid")
        return torch.from_numpy(self.reader.read(name, valid[:1])[0].copy())
