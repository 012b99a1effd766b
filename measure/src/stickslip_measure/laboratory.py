"""An experiment, and its laboratory, which opens scenes on one simulator."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from stickslip_measure.contract import Floats, Rod, Sheet
from stickslip_measure.process import (
    PATIENCE,
    AdapterError,
    AdapterProcess,
    Description,
    Program,
    Simulation,
)

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""

DOWN = np.array([0.0, 0.0, -GRAVITY])

REST_SHARE = 1e-5
"""A scene is at rest if no vertex moves by more than this share of its length between looks."""

LOOK = 0.25
"""Time between two looks at a scene that settles [s]."""

STEADY_SHARE = 0.05
"""Share of its length by which the mean of a scene that swings may differ between two quarters.

A strip that swings by half of its length without damping differs by 4 %, since a quarter has no
whole number of swings.
"""


class NoValueError(AdapterError):
    """The scene ran, and its motion has no number."""

    state = "no value"


class SleepError(AdapterError):
    """The simulator stopped to simulate."""

    state = "sleeps"


@dataclass(frozen=True)
class Reading:
    """The result of an experiment at one resolution."""

    value: float
    expected: float

    x: Floats
    """Abscissae of the picture."""

    measured: Floats
    reference: Floats
    """Ordinates of the picture: measured, and of the closed form."""

    details: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """An experiment with a known answer."""

    name: str
    title: str

    formula: str
    """The closed form, with its source."""

    quantity: str
    """What the value is."""

    unit: str
    """Unit of value and error. Without one, the error is relative."""

    needs: frozenset[str]
    """Capabilities of the contract."""

    cells: tuple[int, ...]
    """Cells along the cloth, or elements of the rod: three resolutions, or one of a check."""

    axes: tuple[str, str]
    """Labels of the picture."""

    measure: Callable[["Laboratory", int], Reading] = field(repr=False)

    @property
    def middle(self) -> int:
        """The resolution whose error stands on the page."""
        return self.cells[len(self.cells) // 2]


class Laboratory:
    """Opens scenes on a simulator, one at a time, each in a fresh process.

    Args:
        program: Adapter and interpreter.
        description: The adapter's description of itself.
        setting: Row of its settings.
        log: File for the output of its processes.
        seconds: Time limit of a scene [s].
        budget: Limit of the CPU time of all scenes together [s].
        softer: Factor on the bending stiffness of each scene, which calibrates a simulator whose
            own is off.
        patience: Share of `seconds` that a single step may take.
    """

    def __init__(
        self,
        program: Program,
        description: Description,
        setting: str,
        log: Path,
        seconds: float,
        budget: float = math.inf,
        softer: float = 1.0,
        patience: float = PATIENCE,
    ) -> None:
        self.program = program
        self.description = description
        self.setting = setting
        self.log = log
        self.seconds = seconds
        self.budget = budget
        self.softer = softer
        self.patience = patience
        self.processes: list[AdapterProcess] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in self.processes:
            process.close()

    @property
    def cpu(self) -> float:
        """CPU time of all processes [s]."""
        return sum(process.cpu for process in self.processes)

    @property
    def sources(self) -> dict[str, str]:
        """Digests of the files that decide the results, by path."""
        sources = dict(self.description.sources)
        for process in self.processes:
            sources |= process.sources
        return sources

    def open(self, scene: Sheet | Rod) -> Simulation:
        """Start a scene.

        Raises:
            AdapterError: It could not be set up.
        """
        # Each scene is a new process: nothing of the last one may leak into it.
        for process in self.processes:
            process.close()
        left = self.budget - self.cpu
        process = AdapterProcess(self.program, self.log, self.seconds, left, self.patience)
        self.processes.append(process)
        return Simulation(process, scene, self.setting)


def settled(simulation: Simulation, gravity: Floats, length: float, longest: float) -> Floats:
    """Let a scene come to rest, and return its vertices (V, 3) [m].

    A simulator that cannot damp swings until `longest` [s]. The mean of the last half then stands
    for the rest.

    Args:
        simulation: The scene.
        gravity: Gravity (3,) [m/s^2].
        length: Size of the scene [m].
        longest: Time limit [s].

    Raises:
        NoValueError: The means of the last two quarters differ.
    """
    means = []
    for _ in range(round(longest / LOOK)):
        before = simulation.positions
        frames = simulation.rest(LOOK, gravity)
        means.append(frames.mean(axis=0))
        if float(np.abs(simulation.positions - before).max()) < REST_SHARE * length:
            return simulation.positions
    third, fourth = (np.mean(part, axis=0) for part in np.array_split(means[len(means) // 2 :], 2))
    moving = float(np.abs(fourth - third).max())
    if moving > STEADY_SHARE * length:
        raise NoValueError(
            f"it did not come to rest in {longest:g} s: between the last two quarters of this time "
            f"its mean moves by {1e3 * moving:.3g} mm"
        )
    return np.asarray(0.5 * (third + fourth))
