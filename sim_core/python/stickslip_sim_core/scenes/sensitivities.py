"""Derivatives of a run of a scene by its parameters.

`SceneFamily.differentiated` returns a scene that has them. `Scene.run` records them at each frame.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.sensitivities import DriveRates, Parameter, Term
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes.frames import Frame
from stickslip_sim_core.scenes.holders import Hands, Holder
from stickslip_sim_core.scenes.kind import Record

UNSOLVED = 1e-2
"""Relative change left to one more round of solving a step from which on derivatives are lost."""

ONE_SIDED = 1e-4
"""Change of a parameter, over its size, within which an event makes a frame one-sided."""


class Side(NamedTuple):
    """What moves a scene with a slightly smaller or larger value of a parameter."""

    value: float
    motion: Callable[[float], tuple[Floats, Sequence[Body]]]
    holders: Sequence[Holder]


@dataclass(frozen=True, eq=False)
class SceneSensitivity:
    """A parameter that a run of a scene is differentiated by."""

    name: str
    size: float
    """Size of the parameter, in its unit: the unit of changes that count as small."""

    terms: tuple[Term, ...]
    """Changes of the cloth by the parameter."""

    start: Floats
    """Derivative of the positions at the start: (V, 3) [m per unit]."""

    sides: tuple[Side, Side]

    def rates(self, time: float) -> DriveRates:
        """Return the derivatives of gravity and of the poses of bodies at a time [s]."""
        low, high = self.sides
        width = high.value - low.value
        (gravity_low, bodies_low), (gravity_high, bodies_high) = low.motion(time), high.motion(time)
        gravity = (np.asarray(gravity_high) - np.asarray(gravity_low)) / width
        bodies = [_body_rate(a, b, width) for a, b in zip(bodies_low, bodies_high, strict=True)]
        return DriveRates(
            gravity=gravity if gravity.any() else np.empty((0, 3)),
            bodies=bodies if np.any(bodies) else (),
        )

    def pose_rate(self, holder: int, time: float) -> Floats:
        """Return the derivative of the pose of a holder at a time [s]: (3, 4) per unit."""
        low, high = self.sides
        change = high.holders[holder].pose(time) - low.holders[holder].pose(time)
        return np.asarray(change / (high.value - low.value))


def _body_rate(low: Body, high: Body, width: float) -> tuple[Floats, Floats]:
    """Return the derivatives of the origin of a body [m per unit] and of its turn [rad per unit].

    The turn w of a small rotation R = 1 + [w]x is in its skew part.
    """
    origin = (np.asarray(high.origin, float) - np.asarray(low.origin, float)) / width
    R = np.asarray(high.rotation, float) @ np.asarray(low.rotation, float).T
    skew = 0.5 * (R - R.T)
    return origin, np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / width


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """The derivative of a run by a parameter, at each frame."""

    positions: Floats
    """Of positions: (frames, V, 3) [m per unit].

    They are NaN from a step on whose derivatives could not be solved.
    """

    nearest_event: Floats
    """How far the parameter may change until a contact changes its branch: (frames,).

    It is an estimate to first order, the least of all steps since the frame before; inf where
    nothing touches.
    """

    one_sided: NDArray[np.bool_]
    """Whether an event is within 0.01 % of the parameter: (frames,).

    A difference of runs over a larger change then mixes two branches.
    """

    @property
    def has_effect(self) -> bool:
        """Whether any position depends on the parameter."""
        return bool(self.positions.any())


class AtFrame(NamedTuple):
    """Derivatives at one frame, by each parameter."""

    positions: Floats
    """(P, V, 3)"""
    nearest_events: Floats
    """(P,)"""


class Followed:
    """The derivatives of a run, with those of the vertices that holders carry.

    A holder with the pose M(t) holds x(t) = M(t) y, with y = M(t0)^-1 x(t0) from its grasp at t0.
    So dx/dp = dM/dp y + M dy/dp, and y depends on the parameter through x(t0), too.
    """

    def __init__(self, by: Sequence[SceneSensitivity], hands: Hands, cloth: Cloth) -> None:
        self._by, self._hands, self._cloth = tuple(by), hands, cloth
        # By parameter, and by the number of a holder: dy/dp (K, 3).
        self._points: list[dict[int, Floats]] = [{} for _ in by]
        self._nearest = np.full(len(by), np.inf)
        # Of the solvers before the present one: a grasp makes a new one, with a new report.
        self._unrefined_before, self._unrefined, self._change = 0, 0, 0.0
        if not by:
            return
        cloth.follow([Parameter(each.terms, partial(self._rates, n)) for n, each in enumerate(by)])
        cloth.set_sensitivities(np.stack([each.start for each in by]))
        self.take(0.0)

    def take(self, time: float) -> None:
        """Take over the vertices that holders grasped at this time [s]."""
        derivatives = self._cloth.sensitivities
        self._unrefined_before, self._unrefined = self._unrefined_before + self._unrefined, 0
        for number, by in enumerate(self._by):
            now = {}
            for holder in self._hands.points:
                # A holder keeps the places from its grasp.
                known = self._points[number].get(holder)
                grasped = self._place_rates(by, holder, time, derivatives[number])
                now[holder] = grasped if known is None else known
            self._points[number] = now

    def _place_rates(self, by: SceneSensitivity, holder: int, time: float, dx: Floats) -> Floats:
        """Return dy/dp (K, 3) of y = A^T (x - b), for derivatives dx (V, 3) of all positions."""
        held = self._hands.holders[holder]
        pose, rate = held.pose(time), by.pose_rate(holder, time)
        arm = self._hands.points[holder] @ pose[:, :3].T
        return np.asarray((dx[held.vertices] - rate[:, 3]) @ pose[:, :3] + arm @ rate[:, :3])

    def _rates(self, number: int, time: float) -> DriveRates:
        by = self._by[number]
        held = [np.empty((0, 3))]
        for holder, places in self._hands.points.items():
            pose, rate = self._hands.holders[holder].pose(time), by.pose_rate(holder, time)
            moved = self._points[number][holder] @ pose[:, :3].T
            held.append(moved + places @ rate[:, :3].T + rate[:, 3])
        of_motion = by.rates(time)
        return DriveRates(np.concatenate(held), of_motion.gravity, of_motion.bodies)

    def see_step(self) -> None:
        """Take note of the events of the last step."""
        if not self._by:
            return
        np.minimum(self._nearest, self._cloth.nearest_events, out=self._nearest)
        report = self._cloth.sensitivity_report
        self._unrefined, self._change = report.unrefined, max(self._change, report.change)

    def at_frame(self, frame: Frame) -> AtFrame:
        """Return the derivatives at a frame in the last step."""
        nearest = self._nearest
        self._nearest = np.full(len(self._by), np.inf)
        positions = self._cloth.sensitivities_at(frame.time, straight=frame.straight)
        # All later derivatives are made from those of the step that was not solved.
        if not self._change < UNSOLVED:
            positions = np.full_like(positions, np.nan)
        return AtFrame(positions, nearest)

    def over_frames(self, frames: Sequence[AtFrame]) -> dict[str, Sensitivity]:
        """Return the derivatives at all frames, by the names of parameters."""
        over = {}
        for number, by in enumerate(self._by):
            events = np.array([frame.nearest_events[number] for frame in frames])
            over[by.name] = Sensitivity(
                np.stack([frame.positions[number] for frame in frames]),
                events,
                events < ONE_SIDED * by.size,
            )
        return over

    def labels(self, frames: Sequence[AtFrame]) -> dict[str, Any]:
        """Return how well derivatives were solved, and how large each is.

        `largest_by_NAME` is the largest derivative of a coordinate [m per unit]. It is 0 if the
        parameter has no effect, and NaN if derivatives could not be solved.
        """
        if not self._by:
            return {}
        labels: dict[str, Any] = {
            "unrefined_steps": self._unrefined_before + self._unrefined,
            "refinement_change": self._change,
        }
        for number, by in enumerate(self._by):
            sizes = [np.abs(frame.positions[number]).max() for frame in frames]
            labels[f"largest_by_{by.name}"] = float(max(sizes))
        return labels


def positions_by(sensitivities: Mapping[str, Sensitivity]) -> dict[str, Floats]:
    """Return the derivatives of positions by the names of their arrays."""
    return {f"positions_by_{name}": by.positions for name, by in sensitivities.items()}


def events_of(sensitivities: Mapping[str, Sensitivity]) -> Record:
    """Return the arrays that say where a derivative is that of one side."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, by in sensitivities.items():
        arrays[f"nearest_event_by_{name}"] = by.nearest_event
        arrays[f"one_sided_by_{name}"] = by.one_sided.astype(np.uint8)
    return arrays
