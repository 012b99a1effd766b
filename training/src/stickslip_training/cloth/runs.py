"""Simulated drop-and-drag as meshes, from which clips are rendered while a network trains.

A packed file holds the instants that clips show of many runs with one mesh
(`benchmarks/training/cloth_runs.py` writes it); a dataset that stores its meshes holds them, too.
"""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from stickslip_training.arrays import Array, Floats, Integers, SingleFloats
from stickslip_training.data.reader import DatasetReader, Split

STEP = 1e-5
"""Of the positions in a packed file [m]."""

SLIDING = 60
"""The instant, of 300, at which the branch is read: on the first leg the free edge trails the
holders, or is pushed ahead of them."""


@dataclass(frozen=True, eq=False)
class Runs:
    """Simulations of one mesh, a square grid of `side` x `side` vertices."""

    positions: SingleFloats
    """(runs, frames, side, side, 3) [m]: rows from the free edge up to the held one, columns along
    y.
    """
    instants: tuple[int, ...]
    """Of the frames, of 300 at 2.4 a second."""
    materials: tuple[str, ...]
    """Names of the codes in `material`."""
    material: Integers
    """(runs,)"""
    mu: Floats
    """(runs,)"""
    landed: Integers
    """(runs,): +1 or -1, the side along x to which the free edge lies, seen from the holders, on
    the first leg.
    """

    def __len__(self) -> int:
        return len(self.mu)

    def __getitem__(self, chosen: Array) -> "Runs":
        names = ("positions", "material", "mu", "landed")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def named(self, materials: tuple[str, ...]) -> "Runs":
        """Return the runs with the codes of other names.

        Raise ValueError if one of theirs is missing.
        """
        if missing := set(self.materials) - set(materials):
            raise ValueError(
                f"materials must have those of the runs, and lack {', '.join(sorted(missing))}"
            )
        codes = np.array([materials.index(name) for name in self.materials])
        return replace(self, materials=materials, material=codes[self.material])


def load_runs(path: str | Path) -> Runs:
    """Read a packed file; raise ValueError if it is damaged, or none."""
    try:
        with np.load(path) as file:
            low, high = file["differences"]
            about = [json.loads(str(line)) for line in file["about"]]
            rest = file["rest"]
            instants = tuple(map(int, file["instants"]))
        names = [run["material"] for run in about]
        mu = np.array([run["mu"] for run in about])
    except (BadZipFile, zlib.error, KeyError, EOFError) as error:
        raise ValueError(f"{path} must be a packed file of simulations: {error}") from error
    differences = np.stack([low, high], axis=-1).view(np.int16)[..., 0]
    positions = np.cumsum(differences, axis=1, dtype=np.int16).astype(np.float32) * np.float32(STEP)
    materials = tuple(sorted(set(names)))
    material = np.array([materials.index(name) for name in names])
    return _runs(positions, rest, instants, materials, material, mu)


def runs_of_dataset(
    reader: DatasetReader, split: Split | None, instants: Sequence[int]
) -> tuple[Runs, Integers]:
    """Return the simulations of a dataset with meshes, and the slot of one sample of each.

    Samples of one simulation have the same material, mu and the mesh at the last instant that is
    read.
    """
    for name in ("positions", "rest", "material", "mu"):
        if name not in reader.arrays:
            raise ValueError(
                f"the dataset must have the array {name} to train from meshes: its spec "
                "says store_positions: false"
            )
    slots = []
    meshes = []
    shapes = set()
    for slot in reader.slots(split).tolist():
        mesh = reader.read("positions", [slot])[0][list(instants)]
        if (key := mesh[-1].tobytes()) not in shapes:
            shapes.add(key)
            slots.append(slot)
            meshes.append(mesh)
    if not slots:
        part = "dataset" if split is None else f"split {split} of the dataset"
        raise ValueError(f"the {part} has no valid simulation")
    chosen = np.array(slots)
    rest = reader.read("rest", chosen[:1])[0]
    material = reader.label("material")[chosen].astype(np.int64)
    materials = reader.categories("material")
    mu = reader.label("mu")[chosen]
    return _runs(np.stack(meshes), rest, tuple(instants), materials, material, mu), chosen


def _runs(
    positions: SingleFloats,
    rest: SingleFloats,
    instants: tuple[int, ...],
    materials: tuple[str, ...],
    material: Integers,
    mu: Floats,
) -> Runs:
    grid = positions[:, :, grid_order(rest)].astype(np.float32)
    sliding = next(
        (frame for frame, instant in enumerate(instants) if instant >= SLIDING), len(instants) - 1
    )
    landed = landed_side(positions[:, sliding], rest)
    return Runs(grid, instants, materials, material, np.asarray(mu, dtype=np.float64), landed)


def landed_side(positions: SingleFloats, rest: SingleFloats) -> Integers:
    """Return the side along x, +1 or -1, of the free edge, (runs,).

    Positions are (runs, V, 3) [m] at the instant `SLIDING`.
    """
    x = positions[:, :, 0]
    free, held = (
        np.isclose(rest[:, 1], end, atol=1e-6) for end in (rest[:, 1].min(), rest[:, 1].max())
    )
    return np.where(x[:, free].mean(axis=1) - x[:, held].mean(axis=1) > 0, 1, -1)


def grid_order(rest: SingleFloats) -> Integers:
    """Return the vertices, (side, side), of the square grid that `rest` (V, 2) is.

    Raise ValueError if it is none.
    """
    side = round(len(rest) ** 0.5)
    order = np.lexsort(np.round(rest.T / 1e-6).astype(np.int64))
    if side * side == len(rest):
        grid = rest[order].reshape(side, side, 2)
        steps = np.diff(grid[..., 1], axis=0), np.diff(grid[..., 0], axis=1)
        if all(np.allclose(step, step.flat[0], atol=1e-6) and step.flat[0] > 0 for step in steps):
            return order.reshape(side, side)
    raise ValueError(
        f"rest must be a square grid of vertices to be rendered from: its {len(rest)} "
        "vertices are none"
    )


def between(runs: Runs, gap: float) -> list[tuple[int, int]]:
    """Return pairs of runs of one fabric and landed side that are neighbours in mu.

    Neighbours are no farther apart than `gap`.

    The mesh of a friction between theirs is close to the mean of theirs: the steady states of a leg
    move with mu, and keep their kind. Below `STEEP` they move fast, and two branches exist:
    neighbours there may be half as far apart.
    """
    pairs = []
    for code in np.unique(runs.material):
        for landed in (-1, 1):
            chosen = np.flatnonzero((runs.material == code) & (runs.landed == landed))
            chosen = chosen[np.argsort(runs.mu[chosen], kind="stable")]
            for a, b in pairwise(chosen.tolist()):
                largest = gap if runs.mu[a] >= STEEP else gap / 2
                if runs.mu[b] - runs.mu[a] <= largest:
                    pairs.append((a, b))
    return pairs


STEEP = 0.4
"""mu below which a difference of 0.1 moves edges by several pixels."""
