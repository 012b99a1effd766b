"""Samples of a dataset of any kind as batches for PyTorch.

`Samples` is map-style, and reads a whole batch at a time (`__getitems__`) into one buffer, so
`collate` has nothing to do: give it to a DataLoader as `collate_fn`, or let `loader()` do that.

A buffer that is used again costs less than a new one, which the kernel has to map and clear: clips
read into reused buffers cost a sixth less (benchmarks/results/reader.json). With `ring=n`, n
buffers are used in turn, and **a batch is valid until n further batches have been drawn**: use it
or copy it before. In the workers of a DataLoader every batch has a buffer of its own, for a worker
reads ahead and hands its batches over by reference.

The clips of a batch are tensors with strides: rows of all frames are together in memory, as they
are on disk. Use `reshape`, not `view`, or `contiguous()`.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.distributed
from stickslip_schemas.format.codecs import empty_in_order
from stickslip_schemas.spec.arrays import COMMON_ARRAYS
from torch.utils.data import DataLoader, Dataset, get_worker_info

from stickslip_training.arrays import Array
from stickslip_training.data.reader import DatasetReader, Split


class Item(dict[str, torch.Tensor]):
    """Tensors by name, of one sample.

    `name("material")` names the code of a categorical label.
    """

    def __init__(
        self, tensors: Mapping[str, torch.Tensor], categories: Mapping[str, tuple[str, ...]]
    ) -> None:
        super().__init__(tensors)
        self.categories = categories
        """Names of the codes 0, 1, ... of each categorical label."""

    def name(self, label: str) -> str:
        """Return the name of this sample's category."""
        return self._names(label)[int(self[label])]

    def _names(self, label: str) -> tuple[str, ...]:
        try:
            return self.categories[label]
        except KeyError:
            raise ValueError(
                f"label must be one of {', '.join(self.categories)}, and is {label}"
            ) from None


class Batch(Item):
    """Tensors by name, the first dimension of each is the sample.

    `names("material")` names the codes.
    """

    def names(self, label: str) -> list[str]:
        """Return the name of each sample's category."""
        names = self._names(label)
        return [names[code] for code in self[label].tolist()]

    def __missing__(self, key: Any) -> torch.Tensor:
        # torch's own collate function takes a list of items, and asks for its first.
        if isinstance(key, int):
            raise TypeError(
                "a batch comes whole from the dataset: make the DataLoader with collate_fn=collate"
            )
        raise KeyError(key)


def collate(batch: Any) -> Batch:
    """Return `batch`: the dataset has made it whole."""
    assert isinstance(batch, Batch)  # torch declares a list of items
    return batch


class Samples(Dataset[Item]):
    """Samples of one split: arrays are read sample by sample, labels are in memory.

    An item holds the arrays and labels that were asked for, by name, and `slot` int64 and
    `sample_key` uint8 (32,). Labels are float32 if they are quantities, and int64 if they are
    codes or counts: `item.name("material")` and `batch.names("material")` name a category.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | DatasetReader,
        split: Split | None = None,
        *,
        arrays: Sequence[str] | None = None,
        labels: Sequence[str] | None = None,
        ring: int = 0,
    ) -> None:
        """Open `split` of a dataset, or all of it.

        Args:
            source: A directory, a URL or an open reader.
            split: The split; None takes all samples.
            arrays: Arrays of an item; by default the video, or all curves of a dataset without
                videos.
            labels: Labels of an item; by default all that are one number.
            ring: Buffers that are used in turn; 0 makes a new one for each batch.

        Raises:
            ValueError: The dataset has no such array, the split has no valid sample, or `ring` is
                negative.
        """
        if ring < 0:
            raise ValueError(
                f"ring must be a number of buffers, 0 for a new one each time, and is {ring}"
            )
        self.reader = source if isinstance(source, DatasetReader) else DatasetReader(source)
        known = self.reader.arrays
        if arrays is None:
            # A dataset with videos is large: its meshes and curves are read on demand only.
            curves = [
                array.name
                for array in known.values()
                if not array.is_label and not array.per_sample
            ]
            arrays = ["video"] if "video" in known else curves
        if labels is None:
            common = {array.name for array in COMMON_ARRAYS}
            labels = [
                name
                for name in self.reader.label_names
                if not known[name].shape and name not in common
            ]
        for name in arrays:
            if name not in known:
                raise ValueError(f"the dataset has no array {name}; it has {', '.join(known)}")
        self.split = split
        self.slots = self.reader.slots(split)
        """Slot in the dataset of each item, int64 (items,)."""
        if not len(self.slots):
            name = "the dataset" if split is None else f"the split {split}"
            raise ValueError(f"{name} of {self.reader.source} has no valid sample")
        self._arrays = tuple(arrays)
        values = {name: self.reader.label(name)[self.slots] for name in labels}
        # Networks compute in single precision, and index with 64-bit codes.
        self._labels = {
            name: column.astype(np.float32 if column.dtype.kind == "f" else np.int64)
            for name, column in values.items()
        }
        self.categories = {
            name: self.reader.categories(name) for name in labels if self.reader.categories(name)
        }
        """Names of the codes 0, 1, ... of each categorical label."""
        self._ring_length = ring
        self._ring: list[dict[str, torch.Tensor]] = []
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
        item |= {
            name: torch.from_numpy(values[index : index + 1].copy())[0]
            for name, values in self._labels.items()
        }
        item |= {"slot": torch.tensor(int(slot[0])), "sample_key": self._sample_keys(slot)[0]}
        return Item(item, self.categories)

    def __getitems__(self, indices: Sequence[int]) -> Batch:
        """Return a batch of samples, read into one buffer for each array.

        See the module on `ring`.
        """
        chosen = np.asarray(indices, dtype=np.int64)
        slots = self.slots[chosen]
        batch = Batch(self._buffers(len(slots)), self.categories)
        # One read into each buffer, without a copy of every sample.
        for name in self._arrays:
            self.reader.read_into(name, slots, batch[name].numpy())
        for name, values in self._labels.items():
            batch[name] = torch.from_numpy(values[chosen])
        batch["slot"] = torch.from_numpy(slots)
        batch["sample_key"] = self._sample_keys(slots)
        return batch

    def loader(
        self, batch_size: int, *, shuffle: bool = False, **options: Any
    ) -> "DataLoader[Item]":
        """Return a DataLoader over this dataset.

        DataLoader takes `options`; `collate_fn` is set here.
        """
        return DataLoader(
            self, batch_size=batch_size, shuffle=shuffle, collate_fn=collate, **options
        )

    def close(self) -> None:
        self.reader.close()

    def _sample_keys(self, slots: Array) -> torch.Tensor:
        return torch.from_numpy(self.reader.label("sample_key")[slots])

    def _buffers(self, count: int) -> dict[str, torch.Tensor]:
        """Return a tensor (count, *sample shape) for each array, new or of the ring."""
        # Workers send their batches to another process, which would see a buffer change.
        if self._ring_length == 0 or get_worker_info() is not None:
            return self._new_buffers(count)
        turn = self._drawn % self._ring_length
        self._drawn += 1
        # Buffers are made as they are needed; a larger batch needs larger ones.
        if turn == len(self._ring):
            self._ring.append(self._new_buffers(count))
        elif any(len(tensor) < count for tensor in self._ring[turn].values()):
            self._ring[turn] = self._new_buffers(count)
        return {name: tensor[:count] for name, tensor in self._ring[turn].items()}

    def _new_buffers(self, count: int) -> dict[str, torch.Tensor]:
        return {
            name: torch.from_numpy(empty_in_order(self.reader.array(name), count))
            for name in self._arrays
        }


class Stream:
    """An epoch of batches each time it is iterated over, or the rest of one.

    The samples of an epoch are in an order that `seed` and the number of the epoch decide. They are
    dealt out in rounds of `batch_size * world_size`, and process `rank` takes its part of each
    round. So no two processes see the same sample in an epoch, and a run with half the processes
    and twice the batch size sees the same rounds. The last round is left out if it is not full,
    unless there is one process: it then has a smaller batch.

    `state_dict` counts the batches that the loop has been given. Batches that
    workers of the DataLoader have read ahead are read again. Put it into your checkpoint, and
    `load_state_dict` goes on with the next batch, bit for bit.
    """

    def __init__(
        self,
        dataset: Samples,
        batch_size: int,
        *,
        seed: int = 0,
        shuffle: bool = True,
        rank: int | None = None,
        world_size: int | None = None,
        **options: Any,
    ) -> None:
        """Begin with the first batch of epoch 0.

        `rank` and `world_size` come from torch.distributed if it runs; else they are 0 and 1.
        DataLoader takes `options`. Raises ValueError if a number makes no sense, or no
        round is full.
        """
        distributed = torch.distributed
        is_parallel = distributed.is_available() and distributed.is_initialized()
        if rank is None:
            rank = distributed.get_rank() if is_parallel else 0
        if world_size is None:
            world_size = distributed.get_world_size() if is_parallel else 1
        self.rank = rank
        self.world_size = world_size
        if batch_size < 1 or self.world_size < 1:
            raise ValueError(
                f"batch_size and world_size must be at least 1, and are {batch_size} and "
                f"{self.world_size}"
            )
        if not 0 <= self.rank < self.world_size:
            raise ValueError(f"rank must be from 0 to {self.world_size - 1}, and is {self.rank}")
        self.dataset = dataset
        self.batch_size = batch_size
        self.seed = seed
        self.shuffle = shuffle
        self._options = options
        self.epoch = 0
        self.drawn = 0
        """Batches of this epoch that have been given out."""
        if not len(self):
            raise ValueError(
                f"a round is {batch_size * self.world_size} samples, and the dataset has "
                f"{len(dataset)}"
            )

    def __len__(self) -> int:
        """Return the batches of an epoch."""
        whole, rest = divmod(len(self.dataset), self.batch_size * self.world_size)
        return whole + (1 if rest and self.world_size == 1 else 0)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches that are left of this epoch; then the next epoch begins."""
        batches = self._batches()[self.drawn :]
        for batch in DataLoader(
            self.dataset, batch_sampler=batches, collate_fn=collate, **self._options
        ):
            self.drawn += 1
            assert isinstance(batch, Batch)
            yield batch
        self.epoch = self.epoch + 1
        self.drawn = 0

    def _batches(self) -> list[list[int]]:
        # Every process finds the same order, and takes its own part of each round.
        order = np.arange(len(self.dataset))
        if self.shuffle:
            order = np.random.default_rng([self.seed, self.epoch]).permutation(len(order))
        size = self.batch_size * self.world_size
        first = self.rank * self.batch_size
        return [
            order[begin + first :][: self.batch_size].tolist()
            for begin in range(0, len(self) * size, size)
        ]

    def state_dict(self) -> dict[str, Any]:
        """Return how far it has come, in types that JSON has."""
        return self._same() | {"epoch": self.epoch, "drawn": self.drawn}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the state of another stream.

        Raise ValueError if it is of another order.
        """
        for name, value in self._same().items():
            if state.get(name) != value:
                raise ValueError(
                    f"{name} of the stream is {value}, and of the state {state.get(name)}"
                )
        self.epoch, self.drawn = int(state["epoch"]), int(state["drawn"])

    def _same(self) -> dict[str, Any]:
        return {
            "manifest": self.dataset.reader.manifest_digest,
            "split": self.dataset.split,
            "round": self.batch_size * self.world_size,
            "seed": self.seed,
            "shuffle": self.shuffle,
        }
