"""Scenes of cloth: their parts, the driver that runs them, and the run that it returns."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import build_info
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric, fabric, fabric_of_card
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes.evenness import uneven_until
from stickslip_sim_core.scenes.frames import Frame, frame_at
from stickslip_sim_core.scenes.holders import Hands, Hanging, Holder
from stickslip_sim_core.scenes.kind import IMPOSSIBLE_START, Array, Kind, OnFrame, Outcome, Record
from stickslip_sim_core.scenes.sensitivities import (
    AtFrame,
    Followed,
    SceneSensitivity,
    Sensitivity,
    events_of,
    positions_by,
)

REST_SPEED = 1e-3
"""Largest mean speed of a vertex between two frames at which cloth is at rest [m/s]."""

REST_TIME = 0.25
"""Time that cloth must stay this slow [s]. A swing is slow as well when it turns back."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ClothRun:
    """The run of a scene. The z axis of the world points up."""

    positions: Floats
    """Positions of the vertices: (frames, V, 3) [m]."""

    rest: Floats
    """Vertices in the rest plane: (V, 2) [m]."""

    triangles: NDArray[np.int32]
    """Vertices of each triangle: (T, 3)."""

    times: Floats
    """Times of the frames: (frames,) [s]."""

    record: Record
    """Other arrays by name.

    All scenes have `contact_force`, the force of bodies and other cloth on the cloth [N].
    """

    labels: Mapping[str, Any]
    """Numbers of the solver, the checks and the scene, by name.

    The bias that breaks the symmetry of a scene is an example.
    """

    self_intersections: NDArray[np.int32]
    """Number of pairs of triangles that cross: (frames,)."""

    least_distance: float
    """Least distance of vertices and edges in contact, over the ends of all steps [m].

    It is inf without contact.
    """

    rest_time: float
    """Time at which everything came to rest and ended the scene [s], or NaN."""

    code: str
    """Code of the reason why the run is not valid, or empty.

    It is the name of the first check that failed.
    """

    reason: str
    """The reason in words, or empty."""

    sensitivities: Mapping[str, Sensitivity] = field(default_factory=dict)
    """Derivatives by the parameters that the scene was differentiated by, by their names."""

    step_ends: Floats = field(default_factory=lambda: np.empty(0))
    """Ends of the solver's steps: (steps,) [s]."""

    @property
    def valid(self) -> bool:
        return not self.code


class Begun(NamedTuple):
    """A scene at its start."""

    hands: Hands
    cloth: Cloth
    followed: Followed


@dataclass(eq=False, slots=True)
class _Frames:
    """The frames of a run, while it runs."""

    positions: list[Floats] = field(default_factory=list)
    """Positions of the vertices at each frame: (V, 3) [m]."""

    forces: list[Record] = field(default_factory=list)
    """Arrays that `Scene.forces` returned at each frame."""

    crossings: list[int] = field(default_factory=list)
    """Number of pairs of triangles that cross at each frame."""

    derivatives: list[AtFrame] = field(default_factory=list)
    """Derivatives by the parameters at each frame."""

    step_ends: list[float] = field(default_factory=list)
    """Ends of the solver's steps [s]."""

    rest_time: float = np.nan
    """Time at which everything came to rest and ended the scene [s], or NaN."""

    def add(self, frame: Frame, forces: Record, derivatives: AtFrame) -> None:
        """Append a frame."""
        self.positions.append(frame.positions)
        self.crossings.append(frame.crossings)
        self.forces.append(forces)
        self.derivatives.append(derivatives)

    def repeat_last(self, count: int) -> None:
        """Append the last frame `count` times."""
        self.positions += count * self.positions[-1:]
        self.crossings += count * self.crossings[-1:]
        self.forces += count * self.forces[-1:]
        self.derivatives += count * self.derivatives[-1:]

    def record(self) -> Record:
        """Return the recorded arrays with the frames as their first axis."""
        record: dict[str, Array] = {}
        for name in self.forces[0]:
            record[name] = np.stack([forces[name] for forces in self.forces])
        return record


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A scene of cloth: its start, its motion, and the report of its run."""

    mesh: Mesh
    """Mesh of all sheets."""

    fabrics: Sequence[Fabric]
    """One fabric, or one for each sheet."""

    preset: SolverSettings

    start: Floats
    """Positions of the vertices at the start, at rest: (V, 3) [m]."""

    motion: Callable[[float], tuple[Floats, Sequence[Body]]]
    """Function from a time [s] to gravity (V, 3) [m/s^2] and bodies."""

    poses: Callable[[Floats], Floats] | None = None
    """Function from times (T,) [s] to the poses of bodies (T, B, 3, 4).

    With it, holders must take times (T,), too. None: the solver calls `motion` for each time.
    """

    frames: int
    frame_rate: float
    """Frames in a second [1/s]. The first frame is at 0 s."""

    holders: Sequence[Holder] = ()
    """Holders that move vertices along prescribed paths."""

    self_contact: SelfContact | None = None
    surfaces: Sequence[Surface] = ()

    damping: Callable[[float], float] = lambda _time: 0.0
    """Function from a time [s] to a damping [1/s]."""

    forces: Callable[[Cloth], Record] = lambda cloth: {"contact_force": cloth.contact_force()}
    """Function that returns the arrays to record at each frame, for the step around the frame.

    The first frame is before the first step.
    """

    tracks: Mapping[str, Callable[[float], ArrayLike]] = field(default_factory=dict)
    """Poses and other functions of the time to record at each frame.

    A pose is x -> A x + b: (3, 4).
    """

    record: Record = field(default_factory=dict)
    """Arrays to record once."""

    labels: Callable[[ClothRun], Mapping[str, Any]] = lambda _run: {}

    arrays: Callable[[ClothRun], Record] = lambda run: {
        "positions": run.positions,
        "rest": run.rest,
        "triangles": run.triangles,
        **positions_by(run.sensitivities),
    }
    """Function that returns the arrays of the run to store besides its record."""

    still_from: float | None = None
    """Time from which on the scene ends as soon as everything is at rest [s].

    Further frames then repeat the last. None: the scene does not end early.
    """

    kernel: str | None = None
    """Level of the kernels, see `Cloth`."""

    others: Sequence[str] = ()
    """Names of bodies, then of surfaces, then of sheets, for the reasons of checks."""

    reason: str = ""
    """Reason why no run of the scene is valid, or empty."""

    hangings: Sequence[Hanging] = ()
    """Sheets that hang at the start."""

    sensitivities: Sequence[SceneSensitivity] = ()
    """The parameters of the derivatives of a run: see `SceneFamily.differentiated`."""

    step_ends: Floats | None = None
    """`ClothRun.step_ends` of another run, whose steps this one repeats.

    Runs with equal steps depend on parameters without the jumps of a step control. None: the step
    control chooses.
    """

    def begin(self) -> Begun:
        """Return the cloth at the start of the scene, and its holders.

        Raises:
            ValueError: A sheet crosses itself, another sheet or a surface at the start, or is
                inside a body.
        """
        hands = Hands(self.holders, self.start)
        cloth = Cloth(
            self.mesh,
            self.fabrics,
            self.preset,
            held=hands.vertices,
            self_contact=self.self_contact,
            surfaces=self.surfaces,
            kernel=self.kernel,
        )
        cloth.set_state(self.start, bodies=self.motion(0.0)[1])
        return Begun(hands, cloth, Followed(self.sensitivities, hands, cloth))

    def run(self, on_frame: OnFrame | None = None, begun: Begun | None = None) -> ClothRun:
        """Simulate the scene until it ends, or until a check has failed.

        The solver's steps do not depend on the frames: positions at a frame are interpolated within
        a step. `begun` is the result of `begin`, for callers that treat its errors separately.

        Raises:
            ValueError: The scene cannot begin.
        """
        begun = self.begin() if begun is None else begun
        hands, cloth, followed = begun
        frames = self._simulate(begun, on_frame)
        path = np.stack(frames.positions)
        times = np.arange(len(path)) / self.frame_rate
        evidence = self._evidence(frames, cloth, hands)
        worst = checks.values(evidence)
        # A start that is no equilibrium spoils the run even if all checks pass.
        code, reason = (
            ("solver_diverged", self.reason) if self.reason else checks.failed(worst, evidence)
        )
        run = ClothRun(
            positions=path,
            rest=self.mesh.rest,
            triangles=self.mesh.triangles,
            times=times,
            record={**frames.record(), **self._tracked(times), **self.record},
            labels={
                "kernel": cloth.kernel,
                "steps": cloth.total.steps,
                "unconverged_steps": cloth.total.unconverged,
                "worst_residual": cloth.worst_residual,
                **worst,
                **followed.labels(frames.derivatives),
            },
            self_intersections=np.array(frames.crossings, np.int32),
            least_distance=cloth.total.least_distance,
            rest_time=frames.rest_time,
            code=code,
            reason=reason,
            sensitivities=followed.over_frames(frames.derivatives),
            step_ends=np.array(frames.step_ends),
        )
        # Labels of the scene may depend on the run, such as the side on which a cloth landed.
        return replace(run, labels={**run.labels, **self.labels(run)})

    def _simulate(self, begun: Begun, on_frame: OnFrame | None) -> _Frames:
        """Return the frames up to the end of the scene, or until a check has failed."""
        _, cloth, followed = begun
        verdict = checks.Verdict(cloth)
        frames = _Frames()
        first = frame_at(cloth, 0.0, self._bodies)
        frames.add(first, self.forces(cloth), followed.at_frame(first))
        calm = 0
        # No run of a scene with a reason is valid, so it has its first frame alone.
        for number in range(1, 1 if self.reason else self.frames):
            time = number / self.frame_rate
            self._advance(begun, time, verdict, frames.step_ends)
            # A check has failed, or the budget is spent, and the cloth has not reached the frame.
            if cloth.time < time:
                break
            frame = frame_at(cloth, time, self._bodies)
            frames.add(frame, self.forces(cloth), followed.at_frame(frame))
            if on_frame is not None:
                on_frame(number + 1, self.frames)
            if verdict.see_frame(frame.crossings if self.self_contact else 0):
                break
            calm = calm + 1 if self._is_still(time, *frames.positions[-2:]) else 0
            if calm >= REST_TIME * self.frame_rate:
                frames.rest_time = time
                # Every sample of the scene has the same number of frames.
                frames.repeat_last(self.frames - len(frames.positions))
                break
        return frames

    def _bodies(self, time: float) -> Sequence[Body]:
        return self.motion(time)[1]

    def _evidence(self, frames: _Frames, cloth: Cloth, hands: Hands) -> checks.Seen:
        """Return the arguments of the checks of a run that has ended."""
        last_time = (len(frames.positions) - 1) / self.frame_rate
        return checks.Seen(
            cloth,
            # A lost run stops between frames, and its last positions may be no numbers.
            np.stack([*frames.positions, cloth.positions]),
            # Without self-contact cloth may pass through itself, so crossings are no fault.
            max(frames.crossings) if self.self_contact else 0,
            uneven_until(last_time, cloth, hands.driving(self.motion)),
            self.others,
        )

    def _tracked(self, times: Floats) -> Record:
        """Return the poses and other functions of the time at the frames (F,) [s], by name."""
        tracked: dict[str, Array] = {}
        for name, at in self.tracks.items():
            tracked[name] = np.stack([np.asarray(at(float(time))) for time in times])
        return tracked

    def _is_still(self, time: float, before: Floats, now: Floats) -> bool:
        """Return whether nothing moved between two frames (V, 3) [m], and nothing will move."""
        if self.still_from is None or time <= self.still_from:
            return False
        return float(np.linalg.norm(now - before, axis=1).max()) <= REST_SPEED / self.frame_rate

    def _advance(
        self, begun: Begun, end: float, verdict: checks.Verdict, step_ends: list[float]
    ) -> None:
        """Take steps until one ends at `end` [s] or later, and grasp and release on the way.

        Ends of steps are added to `step_ends`. A lost run stops before.
        """
        hands, cloth, followed = begun
        poses = self.poses

        def see_step() -> bool:
            step_ends.append(cloth.time)
            followed.see_step()
            return verdict.see_step()

        path = None if poses is None else lambda times: (hands.at(times), poses(times))
        while cloth.time < end and cloth.spent <= 1.0 and not verdict.is_lost:
            # A step ends exactly at each event, so equal times are a safe test.
            if cloth.time in hands.events:
                cloth.hold(hands.take(cloth.time, cloth.positions), self.motion(cloth.time)[1])
                followed.take(cloth.time)
            event = min((event for event in hands.events if event > cloth.time), default=np.inf)
            cloth.advance(
                min(end, event),
                hands.driving(self.motion),
                path=path,
                event=event,
                damping=self.damping,
                is_over=see_step,
                may_fail=verdict.allows_failure,
                ends=self.step_ends,
            )

    def outcome(self, on_frame: OnFrame | None = None) -> Outcome:
        """Run the scene and return the arrays and labels to store.

        A scene that cannot begin is rejected. Errors of the run itself are bugs, and the caller
        gets them.
        """
        try:
            begun = self.begin()
        except ValueError as error:
            return Outcome(reason=str(error), code=IMPOSSIBLE_START)
        run = self.run(on_frame, begun)
        # All worst values help to tell a cause from its consequences.
        if not run.valid:
            worst = ", ".join(
                f"{check.name} {run.labels[check.name]:.4g}" for check in checks.CHECKS
            )
            return Outcome(reason=f"{run.reason}; worst values: {worst}", code=run.code)
        # Cut off rather than wrapped around to negative numbers.
        crossings = np.minimum(run.self_intersections, np.iinfo(np.int16).max).astype(np.int16)
        arrays: Record = {**self.arrays(run), **run.record, **events_of(run.sensitivities)}
        single = {
            name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in arrays.items()
        }
        return Outcome({**single, "self_intersections": crossings}, run.labels)


def fabric_labels(cloth_fabric: Fabric, prefix: str = "") -> dict[str, Any]:
    """Return the labels of a fabric, whose names begin with `prefix`."""
    return {
        f"{prefix}areal_density": cloth_fabric.density,
        f"{prefix}bending_rigidity": np.diag(cloth_fabric.rigidity).tolist(),
        # The inverse of the card's number: constant bending is its limit 0, and not infinity.
        f"{prefix}softening_length": 0.0
        if cloth_fabric.softening is None
        else 1.0 / cloth_fabric.softening,
        f"{prefix}stretching_stiffness": cloth_fabric.stretching[0].tolist(),
    }


def cloth_kernel() -> str:
    """Return the default level of the kernels.

    The environment variable sets it. Otherwise it is the widest level of this processor.
    """
    return build_info().cloth_kernel


def cloth_kind(scene: Callable[..., Scene]) -> Kind:
    """Return the kind of simulation that runs the scenes that `scene` makes from physics."""

    def simulate(
        simulations: Sequence[Mapping[str, Any]], on_frame: OnFrame | None
    ) -> list[Outcome]:
        return [scene(**_of_materials(physics)).outcome(on_frame) for physics in simulations]

    return Kind(simulate, "stickslip_sim_core.cloth", kernel=cloth_kernel)


def _of_materials(physics: Mapping[str, Any]) -> dict[str, Any]:
    """Return physics with a fabric instead of its name and custom numbers."""
    known = dict(physics)
    name = known.pop("material")
    numbers = known.pop("fabric", None)
    cloth_fabric = fabric(name) if numbers is None else fabric_of_card(name, numbers)
    return {**known, "material": cloth_fabric}
