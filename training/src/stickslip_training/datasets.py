"""Torch datasets of rods and of cloth clips.

They are map-style, and read a whole batch at a time (`__getitems__`) into one buffer, so that `collate` has nothing to
do: give it to a DataLoader as `collate_fn`, or let `loader()` do that.

A buffer that is used again costs less than a new one, which the kernel has to map and clear: clips read into reused
buffers cost about a third (benchmarks/reader.py). With `ring=n`, n buffers are used in turn, and **a batch is valid
until n further batches have been drawn**: use it or copy it before. In the workers of a DataLoader every batch has a
buffer of its own whatever `ring` says, for a worker reads ahead and hands its batches over by reference.
"""

import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from stickslip_schemas.clips import shown_frames
from stickslip_schemas.jobs import ClothDragSpec
from stickslip_schemas.layout import SAMPLE_KEY_BYTES
from torch.utils.data import DataLoader, Dataset, get_worker_info

from stickslip_training.reader import Array, DatasetReader, Split

Item = dict[str, torch.Tensor]


class Batch(Item):
    """Tensors by name, the first dimension of each is the sample."""

    def __missing__(self, key: Any) -> torch.Tensor:
        if isinstance(key, int):  # torch's own collate function takes a list of items, and asks for its first
            raise TypeError("a batch comes whole from the dataset: make the DataLoader with collate_fn=collate")
        raise KeyError(key)


def collate(batch: Any) -> Batch:
    """Return `batch`: the dataset has made it whole."""
    assert isinstance(batch, Batch)  # torch declares a list of items
    return batch


class _SampleDataset(Dataset[Item]):
    """Samples of one split: `arrays` are read sample by sample, `labels` are in memory."""

    def __init__(
        self,
        source: str | os.PathLike[str] | DatasetReader,
        split: Split | None,
        *,
        kind: Literal["rod_hang", "cloth_drag"],
        arrays: Sequence[str],
        labels: Sequence[str],
        ring: int,
    ) -> None:
        if ring < 0:
            raise ValueError(f"ring must be a number of buffers, 0 for a new one each time, and is {ring}")
        self.reader = source if isinstance(source, DatasetReader) else DatasetReader(source)
        if self.reader.kind != kind:
            raise ValueError(
                f"kind of the dataset must be {kind} for a {type(self).__name__}: it is {self.reader.kind}"
            )
        for name in arrays:
            if name not in self.reader.arrays:
                raise ValueError(f"the dataset has no array {name}; it has {', '.join(self.reader.arrays)}")
        self.split = split
        self.slots = self.reader.slots(split)
        """Slot in the dataset of each item, int64 (items,)."""
        self._arrays = tuple(arrays)
        self._labels = {name: _for_torch(self.reader.label(name)[self.slots]) for name in labels}
        self._ring_length = ring
        self._ring: list[Item] = []
        self._drawn = 0

    def __len__(self) -> int:
        """Return the number of valid samples of the split."""
        return len(self.slots)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_ring": [], "_drawn": 0}  # buffers belong to one process

    def __getitem__(self, index: int) -> Item:
        """Return one sample: tensors without a sample dimension, in memory of its own."""
        slot = self.slots[[index]]
        item = {name: torch.from_numpy(self.reader.read(name, slot)[0]) for name in self._arrays}
        item |= {name: torch.from_numpy(values[index : index + 1].copy())[0] for name, values in self._labels.items()}
        return item | {"slot": torch.tensor(int(slot[0])), "sample_key": self._sample_keys(slot)[0]}

    def __getitems__(self, indices: Sequence[int]) -> Batch:
        """Return a batch of samples, read into one buffer for each array; see the module on `ring`."""
        chosen = np.asarray(indices, dtype=np.int64)
        slots = self.slots[chosen]
        batch = Batch(self._buffers(len(slots)))
        for name in self._arrays:
            self.reader.read_into(name, slots, batch[name].numpy())
        for name, values in self._labels.items():
            batch[name] = torch.from_numpy(values[chosen])
        batch["slot"] = torch.from_numpy(slots)
        batch["sample_key"] = self._sample_keys(slots)
        return batch

    def loader(self, batch_size: int, *, shuffle: bool = False, **options: Any) -> "DataLoader[Item]":
        """Return a DataLoader over this dataset; `options` are those of DataLoader, but for `collate_fn`."""
        return DataLoader(self, batch_size=batch_size, shuffle=shuffle, collate_fn=collate, **options)

    def close(self) -> None:
        """Let go of connections."""
        self.reader.close()

    def _sample_keys(self, slots: Array) -> torch.Tensor:
        keys = b"".join(bytes.fromhex(self.reader.manifest.sample_keys[slot]) for slot in slots.tolist())
        return torch.frombuffer(bytearray(keys), dtype=torch.uint8).reshape(len(slots), SAMPLE_KEY_BYTES)

    def _buffers(self, count: int) -> Item:
        """Return a tensor (count, *sample shape) for each array, new or of the ring."""
        if self._ring_length == 0 or get_worker_info() is not None:
            return self._new_buffers(count)
        place = self._drawn % self._ring_length
        self._drawn += 1
        if place == len(self._ring):
            self._ring.append(self._new_buffers(count))
        elif any(len(tensor) < count for tensor in self._ring[place].values()):
            self._ring[place] = self._new_buffers(count)
        return {name: tensor[:count] for name, tensor in self._ring[place].items()}

    def _new_buffers(self, count: int) -> Item:
        buffers = {}
        for name in self._arrays:
            array = self.reader.arrays[name]
            buffers[name] = torch.from_numpy(np.empty((count, *array.shape), dtype=array.dtype))
        return buffers


class RodDataset(_SampleDataset):
    """Rods at rest.

    An item holds `centerline` (150, 3) float32, positions over L; `curvature` (150, 3) float32, (twist, bend1, bend2)
    times L; `gamma`, `phi0`, `phi1` float32; `slot` int64; `sample_key` uint8 (32,). With `frame`, also `frame`
    (150, 3, 3) float32; with `views`, also `views` (4, 224, 224, 3) uint8 and `color` (3,) float32.
    """

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
        super().__init__(source, split, kind="rod_hang", arrays=arrays, labels=labels, ring=ring)


class ClipDataset(_SampleDataset):
    """Clips of dragged cloth.

    An item holds `video` (frames, 224, 224, 3) uint8; `material`, `texture`, `viewpoint` int64, codes that
    `categories()` names; `mu` float32; `side` int64, the side to which the drop went; `slot` int64; `sample_key` uint8
    (32,). With `mesh`, also `mesh` (300, vertices, 3) float32 [m], and `rest()` and `triangles()` say what mesh it is.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | DatasetReader,
        split: Split | None = None,
        *,
        mesh: bool = False,
        ring: int = 0,
    ) -> None:
        """Open `split` of a dataset of clips, or all of it; `source` is a directory, a URL or an open reader."""
        labels = ["material", "mu", "texture", "viewpoint", "side"]
        arrays = ["video"] + ["mesh"] * mesh
        super().__init__(source, split, kind="cloth_drag", arrays=arrays, labels=labels, ring=ring)

    @property
    def instants(self) -> tuple[int, ...]:
        """Index into the first dimension of `mesh` of each frame of `video`."""
        spec = self.reader.spec
        assert isinstance(spec, ClothDragSpec)
        return shown_frames(spec.frames)

    def rest(self) -> torch.Tensor:
        """Return the flat cloth of all samples, (vertices, 2) float32 [m]."""
        return self._of_any_sample("rest")

    def triangles(self) -> torch.Tensor:
        """Return the triangles of the mesh of all samples, (triangles, 3) int32."""
        return self._of_any_sample("triangles")

    def _of_any_sample(self, name: str) -> torch.Tensor:
        valid = self.reader.slots()
        if name not in self.reader.arrays or not len(valid):
            raise ValueError(f"the dataset has no {name}: it was made with store_mesh: false, or has no valid sample")
        return torch.from_numpy(self.reader.read(name, valid[:1])[0].copy())

    def categories(self, name: str) -> tuple[str, ...]:
        """Return the names of the codes 0, 1, ... of the label `name`."""
        return tuple(map(str, self.reader.arrays[name].categories))


def _for_torch(values: Array) -> Array:
    """Return labels in the types that models are made for: float32, and int64 for codes."""
    return values.astype(np.float32 if values.dtype.kind == "f" else np.int64)
