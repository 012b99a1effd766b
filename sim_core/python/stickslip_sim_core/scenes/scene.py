"""Scenes of cloth: their parts, the driver that runs all of them, and the run that it returns."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import build_info, self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric, custom_fabric, fabric
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes.holders import Hands, Holder
from stickslip_sim_core.scenes.kind import IMPOSSIBLE_START, Array, Kind, OnFrame, Outcome, Record

REST_SPEED = 1e-3
"""Largest mean speed of a vertex between two frames at which cloth is at rest [m/s]."""

REST_TIME = 0.25
"""How long it is [s], so that a swing that turns back is not at rest."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ClothRun:
    """The run of a scene. World axes: z up."""

    positions: Floats
    """(frames, V, 3) [m]"""

    rest: Floats
    """(V, 2) [m]"""

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: Floats
    """(frames,) [s]"""

    record: Record
    """Other arrays by name. All scenes have `contact_force`, of bodies and other cloth on it [N].
    """

    labels: Mapping[str, Any]
    """Numbers by name: those of the solver, the checks, and of the scene, such as the bias that
    breaks its symmetry.
    """

    self_intersections: NDArray[np.int32]
    """(frames,): pairs of triangles that cross."""

    least_distance: float
    """Least distance of vertices and edges in contact, over the ends of all steps [m]; inf without
    contact.
    """

    rest_time: float
    """When all came to rest, if the scene ends then [s]; NaN if it did not."""

    code: str
    """Code of the reason why the run is not valid: the name of the first check that failed; or
    empty.
    """

    reason: str
    """The reason in words, or empty."""

    @property
    def valid(self) -> bool:
        return not self.code


class Begun(NamedTuple):
    """A scene at its start."""

    hands: Hands
    cloth: Cloth


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A scene of cloth: its start, its motion, and what its run reports."""

    mesh: Mesh
    """Of all sheets."""

    fabrics: Sequence[Fabric]
    """One, or one for each sheet."""

    preset: SolverSettings

    start: Floats
    """(V, 3) [m]: positions of the vertices, at rest."""

    motion: Callable[[float], tuple[Floats, Sequence[Body]]]
    """From a time [s] to gravity (V, 3) [m/s^2] and bodies."""

    poses: Callable[[Floats], Floats] | None = None
    """From times (T,) [s] to the poses of bodies (T, B, 3, 4); holders take times, too. None:
    `motion` is asked.
    """

    frames: int
    frame_rate: float
    """[1/s]; the first frame is at 0 s."""

    holders: Sequence[Holder] = ()
    """What moves vertices as prescribed."""

    self_contact: SelfContact | None = None
    surfaces: Sequence[Surface] = ()

    damping: Callable[[float], float] = lambda _time: 0.0
    """From a time [s] to a damping [1/s]."""

    forces: Callable[[Cloth], Record] = lambda cloth: {"contact_force": cloth.contact_force()}
    """Arrays recorded at each frame, of the step in which it lies; the first frame is before the
    first step.
    """

    tracks: Mapping[str, Callable[[float], ArrayLike]] = field(default_factory=dict)
    """Poses and other functions of the time, recorded at each frame. A pose is (3, 4): x -> A x +
    b.
    """

    record: Record = field(default_factory=dict)
    """Arrays recorded once."""

    labels: Callable[[ClothRun], Mapping[str, Any]] = lambda _run: {}

    arrays: Callable[[ClothRun], Record] = lambda run: {
        "positions": run.positions,
        "rest": run.rest,
        "triangles": run.triangles,
    }
    """Arrays of the run to store besides its record."""

    still_from: float | None = None
    """From this time on [s] the scene ends once all is at rest, and further frames repeat the last;
    None: never.
    """

    kernel: str | None = None
    """Level of the kernels, see `Cloth`."""

    reason: str = ""
    """Reason why no run of the scene is valid, or empty."""

    def begin(self) -> Begun:
        """Return the cloth where the scene starts, and its holders.

        Raises:
            ValueError: A sheet starts across itself, another or a surface, or in a body.
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
        return Begun(hands, cloth)

    def run(self, on_frame: OnFrame | None = None, begun: Begun | None = None) -> ClothRun:
        """Simulate the scene, until it ends or a position is not finite.

        The solver's steps do not depend on the frames, whose positions are interpolated within
        steps. `begun` is what `begin` returned, for callers that tell its errors from others.

        Raises:
            ValueError: The scene cannot begin.
        """
        hands, cloth = self.begin() if begun is None else begun
        paths = [cloth.positions]
        forces = [self.forces(cloth)]
        crossed = [self._crossings(cloth.positions)]
        calm = 0
        rest_time = np.nan
        for frame in range(1, self.frames):
            time = frame / self.frame_rate
            self._advance(cloth, hands, time)
            if cloth.spent > 1.0:
                break
            paths.append(cloth.positions_at(time))
            crossed.append(self._crossings(paths[-1]))
            if crossed[-1] and self.self_contact is not None:
                paths[-1] = cloth.positions_at(time, straight=True)
                crossed[-1] = self._crossings(paths[-1])
            forces.append(self.forces(cloth))
            if on_frame is not None:
                on_frame(frame + 1, self.frames)
            if not np.isfinite(paths[-1]).all():
                break
            calm = calm + 1 if self._is_still(time, paths[-2], paths[-1]) else 0
            if calm >= REST_TIME * self.frame_rate:
                rest_time = time
                break
        missing = 0 if np.isnan(rest_time) else self.frames - len(paths)
        # A scene that has come to rest repeats its last frame.
        for frames in (paths, forces, crossed):
            frames += missing * frames[-1:]  # type: ignore[operator]
        path = np.stack(paths)
        times = np.arange(len(path)) / self.frame_rate
        record: dict[str, Array] = {}
        for name in forces[0]:
            record[name] = np.stack([of_frame[name] for of_frame in forces])
        for name, at in self.tracks.items():
            record[name] = np.stack([np.asarray(at(float(time))) for time in times])
        worst = checks.values(checks.Seen(cloth, path, max(crossed) if self.self_contact else 0))
        code, reason = ("solver_diverged", self.reason) if self.reason else checks.failed(worst)
        run = ClothRun(
            positions=path,
            rest=self.mesh.rest,
            triangles=self.mesh.triangles,
            times=times,
            record={**record, **self.record},
            labels={
                "kernel": cloth.kernel,
                "steps": cloth.total.steps,
                "unconverged_steps": cloth.total.unconverged,
                "worst_residual": cloth.worst_residual,
                **worst,
            },
            self_intersections=np.array(crossed, np.int32),
            least_distance=cloth.total.least_distance,
            rest_time=rest_time,
            code=code,
            reason=reason,
        )
        return replace(run, labels={**run.labels, **self.labels(run)})

    def _crossings(self, positions: Floats) -> int:
        """Return how many pairs of triangles cross; 0 if positions (V, 3) [m] are not finite."""
        return (
            self_intersections(positions, self.mesh.triangles)
            if np.isfinite(positions).all()
            else 0
        )

    def _is_still(self, time: float, before: Floats, now: Floats) -> bool:
        """Return whether nothing moved between two frames, (V, 3) [m], and nothing will move."""
        if self.still_from is None or time <= self.still_from:
            return False
        return float(np.linalg.norm(now - before, axis=1).max()) <= REST_SPEED / self.frame_rate

    def _advance(self, cloth: Cloth, hands: Hands, end: float) -> None:
        """Take steps until one ends at `end` [s] or later, and grasp and release on the way."""
        poses = self.poses
        path = None if poses is None else lambda times: (hands.at(times), poses(times))
        while cloth.time < end and cloth.spent <= 1.0:
            if cloth.time in hands.events:
                cloth.hold(hands.take(cloth.time, cloth.positions), self.motion(cloth.time)[1])
            event = min((event for event in hands.events if event > cloth.time), default=np.inf)
            cloth.advance(
                min(end, event),
                hands.driving(self.motion),
                path=path,
                event=event,
                damping=self.damping,
            )

    def outcome(self, on_frame: OnFrame | None = None) -> Outcome:
        """Run the scene and return the arrays and labels to store.

        A scene that cannot begin is rejected. Errors of the run itself are bugs, and are raised.
        """
        try:
            begun = self.begin()
        except ValueError as error:
            return Outcome(reason=str(error), code=IMPOSSIBLE_START)
        run = self.run(on_frame, begun)
        if not run.valid:
            worst = ", ".join(
                f"{check.name} {run.labels[check.name]:.4g}" for check in checks.CHECKS
            )
            return Outcome(reason=f"{run.reason}; worst values: {worst}", code=run.code)
        crossings = np.minimum(run.self_intersections, np.iinfo(np.int16).max).astype(np.int16)
        arrays: Record = {**self.arrays(run), **run.record}
        single = {
            name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in arrays.items()
        }
        return Outcome({**single, "self_intersections": crossings}, run.labels)


def fabric_labels(made: Fabric, prefix: str = "") -> dict[str, Any]:
    """Return the labels of a fabric, whose names begin with `prefix`."""
    return {
        f"{prefix}areal_density": made.density,
        f"{prefix}bending_rigidity": np.diag(made.rigidity).tolist(),
        f"{prefix}stretching_stiffness": made.stretching[0].tolist(),
    }


def cloth_kernel() -> str:
    """Return the default level of the kernels.

    It is that of the environment variable, or the widest of this processor.
    """
    return build_info().cloth_kernel


def cloth_kind(scene: Callable[..., Scene]) -> Kind:
    """Return the kind whose simulations are the scenes that `scene` makes of their physics."""

    def simulate(
        simulations: Sequence[Mapping[str, Any]], on_frame: OnFrame | None
    ) -> list[Outcome]:
        return [scene(**_of_materials(physics)).outcome(on_frame) for physics in simulations]

    return Kind(simulate, "stickslip_sim_core.cloth", kernel=cloth_kernel)


def _of_materials(physics: Mapping[str, Any]) -> dict[str, Any]:
    """Return physics with fabrics instead of their names, the user's own numbers, and factors."""
    known = dict(physics)
    factors = {name: known.pop(name, 1.0) for name in ("density", "bending", "stretching")}
    name = known.pop("material")
    numbers = known.pop("fabric", None)
    made = fabric(name) if numbers is None else custom_fabric(name, **numbers)
    return {**known, "material": made.scaled(**factors)}
