"""Batches in an order that follows from a seed, and that a saved state continues."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch.distributed
from torch.utils.data import DataLoader

from stickslip_training.data.samples import Batch, Samples, collate


class Stream:
    """An epoch of batches each time it is iterated over, or the rest of one.

    The samples of an epoch are in an order that `seed` and the number of the epoch decide. They are dealt out in rounds
    of `batch_size * world_size`, and process `rank` takes its part of each round. So no two processes see the same
    sample in an epoch, and a run with half the processes and twice the batch size sees the same rounds. The last round
    is left out if it is not full, unless there is one process: it then has a smaller batch.

    `state_dict` counts the batches that the loop has been given: those that workers of the DataLoader have read ahead
    are read again. Put it into your checkpoint, and `load_state_dict` goes on with the next batch, bit for bit.
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

        `rank` and `world_size` are those of torch.distributed where it runs, else 0 and 1. `options` are those of
        DataLoader. Raises ValueError where a number makes no sense, or no round is full.
        """
        runs = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if runs else 0
        self.world_size = world_size if world_size is not None else torch.distributed.get_world_size() if runs else 1
        if batch_size < 1 or self.world_size < 1:
            raise ValueError(
                f"batch_size and world_size must be at least 1, and are {batch_size} and {self.world_size}"
            )
        if not 0 <= self.rank < self.world_size:
            raise ValueError(f"rank must be from 0 to {self.world_size - 1}, and is {self.rank}")
        self.dataset, self.batch_size, self.seed, self.shuffle = dataset, batch_size, seed, shuffle
        self._options = options
        self.epoch = 0
        self.drawn = 0
        """Batches of this epoch that have been given out."""
        if not len(self):
            raise ValueError(f"a round is {batch_size * self.world_size} samples, and the dataset has {len(dataset)}")

    def __len__(self) -> int:
        """Return the batches of an epoch."""
        whole, rest = divmod(len(self.dataset), self.batch_size * self.world_size)
        return whole + (1 if rest and self.world_size == 1 else 0)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches that are left of this epoch; then the next epoch begins."""
        batches = self._batches()[self.drawn :]
        for batch in DataLoader(self.dataset, batch_sampler=batches, collate_fn=collate, **self._options):
            self.drawn += 1
            assert isinstance(batch, Batch)
            yield batch
        self.epoch, self.drawn = self.epoch + 1, 0

    def _batches(self) -> list[list[int]]:
        count = len(self.dataset)
        order = np.random.default_rng([self.seed, self.epoch]).permutation(count) if self.shuffle else np.arange(count)
        size = self.batch_size * self.world_size
        first = self.rank * self.batch_size
        return [order[begin + first :][: self.batch_size].tolist() for begin in range(0, len(self) * size, size)]

    def state_dict(self) -> dict[str, Any]:
        """Return how far it has come, in types that JSON has."""
        return self._same() | {"epoch": self.epoch, "drawn": self.drawn}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where the stream was that `state` is of; raise ValueError where it is of another order."""
        for name, value in self._same().items():
            if state.get(name) != value:
                raise ValueError(f"{name} of the stream is {value!r}, and of the state {state.get(name)!r}")
        self.epoch, self.drawn = int(state["epoch"]), int(state["drawn"])

    def _same(self) -> dict[str, Any]:
        return {
            "manifest": self.dataset.reader.manifest_digest,
            "split": self.dataset.split,
            "round": self.batch_size * self.world_size,
            "seed": self.seed,
            "shuffle": self.shuffle,
        }
