"""Maps of a parameter grid: for each pair of axes, the outcomes of the samples in each cell."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from typing import Any

from stickslip_schemas.base.states import TaskState
from stickslip_schemas.plan.grid import grid
from stickslip_schemas.spec.jobs import JobSpec

CELLS = 12
"""Most cells of a map along an axis. An axis with no more values than that has a cell for each."""

MOST_SAMPLES = 20_000
"""Larger grids have no map, because reading the states of so many samples takes seconds."""

LOST = (TaskState.rejected, TaskState.failed)


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of the grid, divided into cells."""

    name: str
    labels: tuple[str, ...]
    """The value of each cell, or, where cells hold several values, their bounds: one more than there are cells."""
    size: int
    """Number of cells."""
    cell: dict[Any, int]
    """The cell of each value."""

    def bounds(self, cell: int) -> str:
        """Return the values of a cell as text."""
        return self.labels[cell] if len(self.labels) == self.size else f"{self.labels[cell]} to {self.labels[cell + 1]}"

    @property
    def range(self) -> str:
        """The first and the last value as text."""
        return self.labels[0] if len(self.labels) == 1 else f"{self.labels[0]} to {self.labels[-1]}"

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Positions in cells, and texts, of the first, the middle and the last label."""
        shift = 0.5 if len(self.labels) == self.size else 0.0
        last = len(self.labels) - 1
        return [(place + shift, self.labels[place]) for place in sorted({0, last // 2, last})]

    @staticmethod
    def of(name: str, points: Sequence[dict[str, Any]]) -> "Axis":
        """Return an axis in at most `CELLS` cells."""
        values = sorted({point[name] for point in points})
        if len(values) <= CELLS:
            return Axis(name, tuple(map(_text, values)), len(values), {value: i for i, value in enumerate(values)})
        if isinstance(values[0], str):  # names have no distances: each cell gets as many
            starts = [values[i * len(values) // CELLS] for i in range(CELLS)]
            return Axis(name, (*starts, values[-1]), CELLS, {v: i * CELLS // len(values) for i, v in enumerate(values)})
        low, high = values[0], values[-1]
        bounds = tuple(_text(low + (high - low) * i / CELLS) for i in range(CELLS + 1))
        cells = {value: min(int(CELLS * (value - low) / (high - low)), CELLS - 1) for value in values}
        return Axis(name, bounds, CELLS, cells)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float | int) else str(value)


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a map: its column and row, counted from the lower left, and the numbers of its samples."""

    i: int
    j: int
    region: str
    """Its values on both axes as text."""
    count: int
    done: int
    lost: int


@dataclass(frozen=True, slots=True)
class GridMap:
    """The cells over two axes that hold samples, column by column."""

    across: Axis
    up: Axis
    cells: tuple[Cell, ...]


def grid_maps(spec: JobSpec, states: Sequence[TaskState], *, most: int | None = None) -> list[GridMap]:
    """Return the maps of the states by slot, for each pair of axes or for the `most` first pairs.

    A grid with one axis of several values has one map with one row.
    """
    points = list(grid(spec))
    axes = [axis for axis in (Axis.of(name, points) for name in spec.named_axes) if axis.size > 1]
    if len(axes) == 1:
        axes.append(Axis("", ("",), 1, {None: 0}))
        points = [{**point, "": None} for point in points]
    return [_map(across, up, points, states) for across, up in islice(combinations(axes, 2), most)]


def _map(across: Axis, up: Axis, points: Sequence[dict[str, Any]], states: Sequence[TaskState]) -> GridMap:
    places = [(across.cell[point[across.name]], up.cell[point[up.name]]) for point in points]
    all_, done, lost = Counter(places), Counter[tuple[int, int]](), Counter[tuple[int, int]]()
    for place, state in zip(places, states, strict=True):
        done[place] += state is TaskState.succeeded
        lost[place] += state in LOST
    cells = []
    for (i, j), count in sorted(all_.items()):
        region = f"{across.name} {across.bounds(i)}" + (f", {up.name} {up.bounds(j)}" if up.name else "")
        cells.append(Cell(i, j, region, count, done[i, j], lost[i, j]))
    return GridMap(across, up, tuple(cells))
