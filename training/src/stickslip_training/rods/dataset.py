"""Rods of a dataset in memory, the splits that a run uses, and noise of centrelines."""

from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import AnyFloats, Array, Integers, SingleFloats
from stickslip_training.data.reader import DatasetReader, Split

KIND = "rod_hang"

POINTS = 150
"""Of a centreline that the networks take."""

FEW_RODS = 30
"""With fewer test rods than this, a report warns that its medians mean little."""


@dataclass(frozen=True)
class Rods:
    """Rods in memory: centrelines over L and strains times L, float32 (rods, 150, 3), and their slots."""

    slots: Integers
    centerline: SingleFloats
    strains: SingleFloats

    def __len__(self) -> int:
        return len(self.slots)

    def __getitem__(self, chosen: slice | Array) -> "Rods":
        return Rods(self.slots[chosen], self.centerline[chosen], self.strains[chosen])


def load_splits(reader: DatasetReader, evaluation_rods: int) -> tuple[dict[str, Rods], list[str]]:
    """Read the three splits, of the test split no more than `evaluation_rods`; return them, and notes on them.

    Where a split is empty, another one takes its place, with a note.
    """
    if reader.kind != KIND:
        raise ValueError(f"kind of the dataset must be {KIND} to train on curvature: it is {reader.kind}")
    points = reader.arrays["centerline"].shape[0]
    if points != POINTS:
        raise ValueError(f"centrelines must have {POINTS} points for this network, and have {points}")
    splits: tuple[Split, ...] = ("train", "validation", "test")
    slots = {split: reader.slots(split) for split in splits}
    if not any(map(len, slots.values())):
        raise ValueError(f"dataset {reader.manifest.dataset} has no valid sample to train on")
    notes = []
    if not len(slots["train"]):
        other: Split = "validation" if len(slots["validation"]) > len(slots["test"]) else "test"
        slots["train"] = slots[other]
        notes.append(f"The train split is empty: the network was trained on the {other} split.")
    if not len(slots["validation"]):
        notes.append("The validation split is empty: the model has the last weights, not the best ones.")
    if not len(slots["test"]):
        other = "validation" if len(slots["validation"]) else "train"
        slots["test"] = slots[other]
        seen = "chose the weights" if other == "validation" else "trained the network"
        notes.append(f"The test split is empty: errors are those on the {other} split, which {seen}.")
    if set(slots["test"]) & set(slots["train"]):
        notes.append("Test rods were trained on: these errors do not hold for other rods.")
    if len(slots["test"]) > evaluation_rods:
        notes.append(f"Evaluated on {evaluation_rods} of {len(slots['test'])} test rods (evaluation_rods).")
        slots["test"] = slots["test"][:evaluation_rods]
    if len(slots["test"]) < FEW_RODS:
        notes.append(f"There are only {len(slots['test'])} test rods: take medians and percentiles as a hint.")
    arrays = ("centerline", "curvature")
    return {split: Rods(some, *(reader.read(name, some) for name in arrays)) for split, some in slots.items()}, notes


def with_white_noise(centerline: AnyFloats, share: float, seed: tuple[int, ...]) -> SingleFloats:
    """Add independent normal noise of standard deviation `share` (of L) to every coordinate of every point.

    The same `seed` gives the same noise. `centerline` is over L, (..., points, 3).
    """
    generator = np.random.default_rng(seed)
    noise = generator.standard_normal(centerline.shape, dtype=np.float32)
    return (centerline + np.float32(share) * noise).astype(np.float32, copy=False)
