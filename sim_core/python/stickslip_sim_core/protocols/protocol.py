"""What all protocols share: a protocol states its points, its measurement and its master curve; `run` is common."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core._sim_core import build_info
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.result import Curve, ProtocolResult, Setting
from stickslip_sim_core.protocols.strip import MeshKind, mesh_kinds, mesh_names


@dataclass
class Tally:
    """Diagnostics of all simulations of one protocol."""

    steps: int = 0
    unconverged_steps: int = 0
    least_distance: float = np.inf  # m
    largest: float = 0.0
    """Of a quantity of the protocol's own, such as drift."""

    def count(self, cloth: Cloth) -> None:
        """Add a cloth that was simulated."""
        self.steps += cloth.steps
        self.unconverged_steps += cloth.unconverged_steps
        self.least_distance = min(self.least_distance, cloth.least_distance)

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
    """The field that holds the abscissae, which all curves share."""

    parameters: ClassVar[Mapping[str, str]] = {}
    """Parameters of a curve, and the fields that hold their values. There is a curve for each combination."""

    tolerance: float
    """Largest |relative error| that passes."""

    tally: Tally = field(default_factory=Tally, init=False, repr=False)

    @abstractmethod
    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        """Return the measured value at a point of the curve with the parameters `at`, and that of its master curve."""

    @abstractmethod
    def reported(self) -> dict[str, Setting]:
        """Return settings and diagnostics for the result, once all is measured."""

    def run(self) -> ProtocolResult:
        """Measure all points of all curves."""
        curves = []
        x = tuple(float(point) for point in getattr(self, self.points))
        for values in product(*(getattr(self, values) for values in self.parameters.values())):
            at = dict(zip(self.parameters, values, strict=True))
            pairs = [self.measure(point, at) for point in x]
            measured, master = (tuple(float(pair[i]) for pair in pairs) for i in (0, 1))
            curves.append(Curve({name: float(value) for name, value in at.items()}, x, measured, master))
        build = build_info().build_hash
        return ProtocolResult(
            self.name, self.x_name, self.y_name, tuple(curves), self.tolerance, self.reported(), build
        )


@dataclass(kw_only=True, eq=False)
class ClothProtocol(Protocol):
    """A protocol of the cloth solver.

    Raises:
        ValueError: There is no such preset.
    """

    preset: str | SolverSettings = "certified"
    """Solver settings, or their name."""

    solver: SolverSettings = field(init=False, repr=False)

    time_step_name: ClassVar[str] = "time_step"

    def __post_init__(self) -> None:
        self.solver = preset_named(self.preset)

    def reported(self) -> dict[str, Setting]:
        return {"preset": self.solver.name, self.time_step_name: self.solver.time_step}

    def counted(self) -> dict[str, Setting]:
        """Return numbers of steps, for `reported`."""
        return {"steps": self.tally.steps, "unconverged_steps": self.tally.unconverged_steps}


@dataclass(kw_only=True, eq=False)
class MeshedProtocol(ClothProtocol):
    """A protocol of the cloth solver that is run on several meshes; `mesh` is a parameter of its curves."""

    parameters: ClassVar = {"mesh": "meshes"}
    grids_max: ClassVar[int] = 4

    cells: int
    """Of a mesh along a side."""

    structured: int = 1
    """Number of grids, at most `grids_max`."""

    unstructured: int = 1
    """Number of unstructured meshes."""

    @property
    def kinds(self) -> list[MeshKind]:
        """Kinds of the meshes."""
        return mesh_kinds(min(self.structured, self.grids_max), self.unstructured)

    @property
    def meshes(self) -> range:
        """Numbers of the meshes."""
        return range(len(self.kinds))

    def reported(self) -> dict[str, Setting]:
        return {**super().reported(), "cells": self.cells, "meshes": mesh_names(self.kinds)}
