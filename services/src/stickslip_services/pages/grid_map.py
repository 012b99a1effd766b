"""Maps of a parameter grid: for each two axes, how many of the samples of a cell are done, rejected or failed."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from stickslip_schemas.base.states import TaskState
from stickslip_schemas.plan.points import grid
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.pages.dataset_page import Axis

MOST_SAMPLES = 20_000
"""A bigger grid is not drawn: its states alone would take seconds to read."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A region of the grid: where it is, what it is called, and the states of its samples."""

    x: float
    y: float
    width: float
    height: float
    name: str
    done: float
    lost: int


@dataclass(frozen=True, slots=True)
class GridMap:
    """The cells over two axes, in a square of 100 by 100."""

    across: str
    across_range: str
    up: str
    up_range: str
    cells: tuple[Cell, ...]


def grid_maps(spec: JobSpec, states: Sequence[TaskState], *, most: int = 3) -> list[GridMap]:
    """Return the maps of the states by slot, of at most so many pairs of axes."""
    points = list(grid(spec))
    axes = [axis for axis in (Axis.of(name, points) for name in spec.named_axes) if axis.size > 1]
    if len(axes) == 1:
        axes.append(Axis("", ("",), 1, {None: 0}))
        points = [{**point, "": None} for point in points]
    return [_map(across, up, points, states) for across, up in list(combinations(axes, 2))[:most]]


def _map(across: Axis, up: Axis, points: Sequence[dict[str, Any]], states: Sequence[TaskState]) -> GridMap:
    places = [(across.cell[point[across.name]], up.cell[point[up.name]]) for point in points]
    asked, done, lost = Counter(places), Counter[tuple[int, int]](), Counter[tuple[int, int]]()
    for place, state in zip(places, states, strict=True):
        done[place] += state is TaskState.succeeded
        lost[place] += state in (TaskState.rejected, TaskState.failed)
    width, height = 100 / across.size, 100 / up.size
    cells = []
    for (i, j), count in sorted(asked.items()):
        region = f"{across.name} {across.bounds(i)}" + (f", {up.name} {up.bounds(j)}" if up.name else "")
        name = f"{region}: {done[i, j]} of {count} done" + (f", {lost[i, j]} lost" if lost[i, j] else "")
        cells.append(Cell(i * width, 100 - (j + 1) * height, width, height, name, done[i, j] / count, lost[i, j]))
    return GridMap(across.name, _range(across), up.name, _range(up), tuple(cells))


def _range(axis: Axis) -> str:
    """Return the first and the last value of an axis."""
    return axis.labels[0] if len(axis.labels) == 1 else f"{axis.labels[0]} to {axis.labels[-1]}"
