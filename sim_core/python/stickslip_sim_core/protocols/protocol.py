"""The common base of all protocols: meshes that they vary, clamped strips, and `run`.

Each protocol defines its points, its measurement and its master curve.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise, product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import StepReport, build_info
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.meshes import Diagonals, Mesh
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.result import Curve, Numbers, ProtocolResult, Refinement, Setting

LENGTH = 0.1
"""Length of every strip [m]."""

DIAGONALS: tuple[Diagonals, ...] = ("alternating", "random", "left", "right")

ALIGNED = 3
"""Rows of square cells at the clamp of an unstructured strip.

With a single row, the tip of a cantilever is off by 2.4 %.
"""

MeshKind = Diagonals | int
"""Diagonals of a grid, or the seed of an unstructured mesh."""


def rectangle(
    width: float,
    length: float,
    cells: tuple[int, int],
    spacing: float,
    kind: MeshKind,
    seed: int,
    aligned: int = 0,
) -> Mesh:
    """Return a mesh of a rectangle [m].

    The mesh is a grid of `cells`, or triangles with sides of about `spacing` [m].

    `seed` draws the diagonals of a grid, and adds to the seed of an unstructured mesh. `aligned`
    rows of cells at the lower end of an unstructured mesh are the rows of a grid.
    """
    if isinstance(kind, int):
        return meshes.unstructured(width, length, spacing, kind + seed, aligned=aligned)
    return meshes.grid(width, length, *cells, kind, seed=seed)


@dataclass(frozen=True, eq=False)
class Strip:
    """A strip along the second axis of its rest plane, clamped at its lower end.

    Two rows of vertices are clamped: half a cell before the clamp, and half a cell behind it. A
    strip that is straight between the rows is thus level at the clamp itself. The mesh is longer
    than the strip by half a cell.
    """

    mesh: Mesh
    cell: float
    """Length of a cell along the strip [m]."""

    @property
    def across(self) -> Floats:
        """Distance of each vertex from the long middle line, with a sign: (V,) [m]."""
        return self.mesh.rest[:, 0]

    @property
    def along(self) -> Floats:
        """Distance of each vertex from the clamp, negative in the first row: (V,) [m]."""
        return self.mesh.rest[:, 1] + 0.5 * (LENGTH - 0.5 * self.cell)

    @property
    def held(self) -> NDArray[np.int64]:
        """Vertices of the two clamped rows."""
        return np.flatnonzero(self.along < 0.75 * self.cell)

    @property
    def tip(self) -> NDArray[np.int64]:
        """Vertices of the free end."""
        return np.flatnonzero(self.along > LENGTH - 0.25 * self.cell)


def cell_of(cells: int) -> float:
    """Return the length of a cell [m] of a strip with `cells` cells along it.

    Half a cell is before the clamp.
    """
    return LENGTH / (cells - 0.5)


@lru_cache(maxsize=16)
def strip(width: float, cells: int, kind: MeshKind) -> Strip:
    """Return a strip of `width` [m] with `cells` cells along it."""
    cell = cell_of(cells)
    shape = max(1, round(width / cell)), cells
    # The seed of an unstructured mesh is its kind already.
    seed = 0 if isinstance(kind, int) else 1
    return Strip(rectangle(width, LENGTH + 0.5 * cell, shape, cell, kind, seed, ALIGNED), cell)


@dataclass
class Tally:
    """Diagnostics of all simulations of one protocol."""

    total: StepReport = field(default_factory=StepReport)
    largest: float = 0.0
    """Largest value of a quantity that the protocol chooses, for example drift."""

    def count(self, cloth: Cloth) -> None:
        """Add the steps of a simulated cloth."""
        self.total.add(cloth.total)

    def note(self, value: float) -> None:
        """Raise `largest` to a value."""
        self.largest = max(self.largest, value)


@dataclass(kw_only=True, eq=False)
class Protocol(ABC):
    """A protocol. Its fields are its settings."""

    name: ClassVar[str]
    x_name: ClassVar[str]
    y_name: ClassVar[str]

    points: ClassVar[str]
    """Name of the field with the abscissae, which all curves share."""

    parameters: ClassVar[Mapping[str, str]] = {}
    """Parameters of a curve, and the names of the fields with their values.

    Each combination of the values has a curve.
    """

    tolerance: float
    """Largest |relative error| that passes."""

    limit_tolerance: float | None = field(default=None, init=False)
    """Largest |relative error| of the limit that passes, in protocols that use three meshes."""

    tally: Tally = field(default_factory=Tally, init=False, repr=False)

    @abstractmethod
    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        """Return the measured value at a point of the curve `at`, and the value of the master."""

    def curve(self, x: Numbers, at: Mapping[str, Any]) -> Curve:
        """Measure the points x of the curve with the parameters `at`."""
        pairs = [self.measure(point, at) for point in x]
        measured = tuple(float(value) for value, _ in pairs)
        master = tuple(float(value) for _, value in pairs)
        return Curve({name: float(value) for name, value in at.items()}, x, measured, master)

    constants: ClassVar[Mapping[str, Setting]] = {}
    """Numbers for the result that no setting changes."""

    @abstractmethod
    def reported(self) -> dict[str, Setting]:
        """Return settings and diagnostics for the result, after all measurements.

        `run` adds `constants` to them.
        """

    def run(self) -> ProtocolResult:
        """Measure all points of all curves."""
        x = tuple(float(point) for point in getattr(self, self.points))
        # Each combination of the parameters' values has a curve.
        values_of = [getattr(self, field) for field in self.parameters.values()]
        curves = []
        for values in product(*values_of):
            curves.append(self.curve(x, dict(zip(self.parameters, values, strict=True))))
        # `reported` comes after the measurements, whose diagnostics it returns.
        return ProtocolResult(
            self.name,
            self.x_name,
            self.y_name,
            tuple(curves),
            self.tolerance,
            {**self.reported(), **self.constants},
            build_info().build_hash,
            self.limit_tolerance,
        )


@dataclass(kw_only=True, eq=False)
class ClothProtocol(Protocol):
    """A protocol of the cloth solver.

    Raises:
        ValueError: The preset is unknown.
    """

    preset: str | SolverSettings = "certified"
    """Solver settings, or their name."""

    solver: SolverSettings = field(init=False, repr=False)

    time_step_name: ClassVar[str] = "time_step"

    def __post_init__(self) -> None:
        self.solver = preset_named(self.preset)

    thickness: ClassVar[float | None] = None
    """Thickness of cloth that touches cloth [m]."""

    def reported(self) -> dict[str, Setting]:
        numbers: dict[str, Setting] = {
            "preset": self.solver.name,
            self.time_step_name: self.solver.time_step,
        }
        total = self.tally.total
        # Not every protocol counts its steps.
        if total.steps:
            numbers |= {"steps": total.steps, "unconverged_steps": total.unconverged}
        if self.thickness is not None:
            numbers["least_distance_over_thickness"] = total.least_distance / self.thickness
        return numbers


@dataclass(kw_only=True, eq=False)
class MeshedProtocol(ClothProtocol):
    """A protocol of the cloth solver that runs on several meshes.

    `mesh` is a parameter of its curves.
    """

    parameters: ClassVar = {"mesh": "meshes"}
    grids_max: ClassVar[int] = 4

    cells: int | tuple[int, int, int]
    """Number of cells along a side of a mesh."""

    structured: int = 1
    """Number of grids, at most `grids_max`."""

    unstructured: int = 1
    """Number of unstructured meshes."""

    @property
    def kinds(self) -> list[MeshKind]:
        return [*DIAGONALS[: min(self.structured, self.grids_max)], *range(self.unstructured)]

    @property
    def meshes(self) -> range:
        return range(len(self.kinds))

    def reported(self) -> dict[str, Setting]:
        kinds = [
            f"{'unstructured' if isinstance(kind, int) else 'grid'} {kind}" for kind in self.kinds
        ]
        meshes = ", ".join(f"{number} {kind}" for number, kind in enumerate(kinds))
        return {**super().reported(), "cells": self.cells, "meshes": meshes}


@dataclass(kw_only=True, eq=False)
class RefinedProtocol(MeshedProtocol):
    """A protocol of strips with cells of three sizes, which give the limit of small cells.

    Raises:
        ValueError: `cells` breaks its rule.
    """

    cells: tuple[int, int, int] = (20, 40, 80)
    """Cells along the strip of three meshes, each at least 1.5 times the number before.

    The defaults are the cells of sheets with 21, 41 and 81 vertices along a side. `measured` is the
    value of the last mesh.
    """

    tolerance: float = 4e-3
    limit_tolerance: float = 1e-3
    """Largest |relative error| of the limit that passes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # Sizes that hardly differ would give no order of convergence.
        if len(self.cells) != 3 or not all(
            2 * fine >= 3 * coarse > 18 for coarse, fine in pairwise(self.cells)
        ):
            raise ValueError(
                "cells: must be three numbers from 7 on, each 1.5 times the one before, "
                f"got {self.cells}"
            )

    def finer(self, x: float) -> int:
        """Return the factor by which all three meshes are finer at a point."""
        return 1

    @abstractmethod
    def measure_with(self, cells: int, x: float, at: Mapping[str, Any]) -> float:
        """Return the value at a point, measured with `cells` cells along the strip."""

    @abstractmethod
    def master(self, x: float, at: Mapping[str, Any]) -> float:
        """Return the value of the master curve at a point."""

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        return self.measure_with(self.finer(x) * self.cells[-1], x, at), self.master(x, at)

    def curve(self, x: Numbers, at: Mapping[str, Any]) -> Curve:
        cells: list[tuple[int, ...]] = []
        sizes: list[tuple[float, ...]] = []
        measured: list[tuple[float, ...]] = []
        # Measure the whole curve on one mesh after the other, the coarsest first.
        for count in self.cells:
            counts = tuple(self.finer(point) * count for point in x)
            pairs = zip(counts, x, strict=True)
            cells.append(counts)
            sizes.append(tuple(cell_of(count) / LENGTH for count in counts))
            measured.append(tuple(self.measure_with(count, point, at) for count, point in pairs))
        return Curve(
            {name: float(value) for name, value in at.items()},
            x,
            measured[-1],
            tuple(self.master(point, at) for point in x),
            Refinement.of(tuple(cells), tuple(sizes), tuple(measured)),
        )
