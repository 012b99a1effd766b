"""Drop and drag: cloth is lowered onto a floor and dragged [thesis, 4.2.3].

The cloth is a square that is held at two corners.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats, check_range
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import MU_MAX, SELF_FRICTION, Body, SelfContact, plane
from stickslip_sim_core.cloth.fabrics import Fabric, fabric
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter
from stickslip_sim_core.scenes.holders import Hang, Hanging, Holder, Hung, hung
from stickslip_sim_core.scenes.kind import Record
from stickslip_sim_core.scenes.scene import ClothRun, Scene, cloth_kind, fabric_labels

SIDE = 0.2
"""Side of the square of cloth [m]."""

HOLDER = 0.01
"""Side of the square holders at two corners [m]."""

CLEARANCE = 0.01
"""Height of the lower edge over the floor at the start [m]."""

DROP = 0.06
"""Travel of the holders down [m]."""

DRAG = 0.3
"""Travel of the holders in each leg [m]."""

LEGS = 4
"""Number of legs: there, back, there, back."""

SPEED = 0.01
"""Cruising speed of the holders [m/s]."""

ACCELERATION = 0.01
"""Acceleration of the holders at the start and end of a travel [m/s^2]."""

FACTORS = (0.1, 10.0)
"""Range of factors of the fabric and of the speed of the holders."""

FRAME_RATE = 2.4
"""Frames in a second [1/s]."""

SECOND_ORDER = False
"""Setting `second_order` of a drag, whatever the preset has.

With it, an undamped cloth flutters after each turn of the holders, and a drag takes 2.7 times the
CPU time.
"""


def travel(time: Floats, distance: Floats) -> Floats:
    """Return the displacement [m] of holders that start and end at rest.

    The holders accelerate with `ACCELERATION` and cruise at `SPEED`.
    """
    # Each ramp covers half the way of cruising as long, so both ramps together add one ramp.
    ramp = SPEED / ACCELERATION
    duration = distance / SPEED + ramp
    t = np.minimum(np.maximum(time, 0.0), duration)
    late = np.where(
        t > duration - ramp,
        distance - 0.5 * ACCELERATION * (duration - t) ** 2,
        SPEED * (t - 0.5 * ramp),
    )
    return np.where(t < ramp, 0.5 * ACCELERATION * t * t, late)


def duration_of(distance: float) -> float:
    """Return the duration [s] of a travel of at least SPEED^2 / ACCELERATION."""
    return distance / SPEED + SPEED / ACCELERATION


def holder_path(time: ArrayLike) -> Floats:
    """Return the displacement (x, z) of the holders [m]: ([T,] 2).

    The holders go down, then to and fro [thesis, 4.2.3].
    """
    legs = np.arange(LEGS)
    # The time since the start of the drop, and of each leg: a leg begins as the one before ends.
    since = np.asarray(time, float)[..., None] - np.append(0.0, LEGS * [duration_of(DROP)])
    ways = travel(since - np.append(0.0, legs * duration_of(DRAG)), np.append(DROP, LEGS * [DRAG]))
    return np.stack([(ways[..., 1:] * (-1.0) ** legs).sum(axis=-1), -ways[..., 0]], axis=-1)


STATIC_RATIO_MAX = 3.0
"""Largest static over kinetic coefficient of friction."""

FRAMES = 300
"""Frames of a whole drop-and-drag."""


def held_by_holders(mesh: meshes.Mesh) -> NDArray[np.intp]:
    """Return the vertices under the holders, at the two corners of the upper edge."""
    # The slack catches vertices on the edge of a holder in spite of rounding.
    inner = SIDE / 2 - HOLDER - 1e-9
    return np.flatnonzero((np.abs(mesh.rest[:, 0]) > inner) & (mesh.rest[:, 1] > inner))


def hang(
    mesh: meshes.Mesh,
    fabric: Fabric,
    *,
    seed: int,
    kernel: str | None = None,
    hanging: Hang = hung,
) -> Hung:
    """Return the shape in which the cloth hangs at rest under its holders, over the floor.

    `hanging` lets it hang.
    """
    # The flat cloth hangs upright in the plane x = 0, so that it faces the direction of the drag.
    flat = np.zeros((len(mesh.rest), 3))
    flat[:, 1] = mesh.rest[:, 0]
    flat[:, 2] = mesh.rest[:, 1] + SIDE / 2 + CLEARANCE
    return hanging(
        mesh, fabric, flat, held_by_holders(mesh), normal=(1.0, 0.0, 0.0), seed=seed, kernel=kernel
    )


@dataclass(frozen=True, kw_only=True)
class Drag:
    """A cloth that is lowered onto a plane and dragged to and fro: see `scene`.

    Raises:
        ValueError: A number breaks its rule.
    """

    fabric: Fabric
    mu: float
    static_ratio: float = 1.0
    """Coefficient of friction at rest, over `mu`; 1 ... 3."""

    mesh: meshes.Mesh
    self_friction: float | None = SELF_FRICTION
    preset: SolverSettings
    frames: int = FRAMES
    seed: int = 0
    kernel: str | None = None
    speed: float = 1.0
    """Factor of the speed of the holders, 0.1 ... 10: their time runs as much faster."""

    def __post_init__(self) -> None:
        check_range("frames", self.frames, 1, FRAMES)
        check_range("speed", self.speed, *FACTORS)
        check_range("static_ratio", self.static_ratio, 1.0, STATIC_RATIO_MAX)

    @property
    def floor(self) -> Body:
        """The floor, with friction of its own at rest if that is larger."""
        floor = plane(self.mu)
        if self.static_ratio == 1.0:
            return floor
        return replace(floor, mu_static=self.static_ratio * self.mu)

    def pose(self, time: ArrayLike) -> Floats:
        """Return the pose of the holders at a time or times [s]: ([T,] 3, 4)."""
        return holder_pose(self.speed * np.asarray(time, float))

    def scene(self, hanging: Hang = hung) -> Scene:
        """Return the scene. `hanging` lets the cloth hang."""
        cloth = hang(self.mesh, self.fabric, seed=self.seed, kernel=self.kernel, hanging=hanging)
        floor = self.floor
        return Scene(
            mesh=self.mesh,
            fabrics=[self.fabric],
            preset=replace(self.preset, second_order=SECOND_ORDER),
            start=cloth.positions,
            holders=[Holder(cloth.held, self.pose)],
            motion=motion_of(cloth, floor),
            poses=lambda times: np.broadcast_to(floor.pose, (len(times), 1, 3, 4)),
            self_contact=None if self.self_friction is None else SelfContact(self.self_friction),
            frames=self.frames,
            frame_rate=FRAME_RATE,
            forces=lambda solver: _forces(solver, cloth),
            tracks={"holder_pose": self.pose},
            labels=lambda run: _labels(run, cloth, self.fabric),
            kernel=self.kernel,
            reason=cloth.reason,
            hangings=[Hanging(0, 0, self.mesh, self.fabric, cloth)],
        )


def scene(
    material: str | Fabric,
    mu: float,
    *,
    self_friction: float | None = SELF_FRICTION,
    preset: str | SolverSettings = "certified",
    mesh: int | meshes.Mesh = 41,
    frames: int = FRAMES,
    seed: int = 0,
    kernel: str | None = None,
) -> Scene:
    """Return the scene of a cloth that is lowered onto a plane and dragged to and fro.

    The cloth hangs at rest, 1 cm over the floor, when the holders start to move. A perfect drop
    would buckle to neither side. Gravity is therefore tilted along x by `bias`, a little more on
    one side of the cloth than on the other. Both the bias and this difference are drawn from
    `seed`. Gravity turns upright within the second after the drop.

    Args:
        material: One of `fabric_names()`, or a fabric. Its warp runs along the held edge.
        mu: Coefficient of friction between cloth and floor, 0 ... 10.
        self_friction: Coefficient of friction of the cloth with itself, 0 ... 10. None turns
            self-contact off.
        preset: Solver settings, or their name.
        mesh: Vertices along a side of a grid, at least 5; or a mesh of the square of side `SIDE`.
        frames: Number of frames, 2.4 a second from 0 on. 300 frames cover the whole motion.
        seed: Seed of the bias.
        kernel: Level of the kernels, see `Cloth`.

    Raises:
        ValueError: An argument breaks its rule.
    """
    return Drag(
        fabric=fabric(material) if isinstance(material, str) else material,
        mu=mu,
        mesh=_square(mesh),
        self_friction=self_friction,
        preset=preset_named(preset),
        frames=frames,
        seed=seed,
        kernel=kernel,
    ).scene()


def _square(mesh: int | meshes.Mesh) -> meshes.Mesh:
    if isinstance(mesh, meshes.Mesh):
        return mesh
    check_range("mesh", mesh, 5, np.inf)
    # `mesh` counts vertices, and a grid takes cells.
    return meshes.grid(SIDE, SIDE, mesh - 1, mesh - 1)


def family(
    material: str | Fabric,
    mu: float,
    *,
    static_ratio: float = 1.0,
    density: float = 1.0,
    bending: float = 1.0,
    stretching: float = 1.0,
    speed: float = 1.0,
    **settings: Any,
) -> SceneFamily:
    """Return the scenes of dragged cloth that differ in friction, fabric and speed.

    They have the arguments below as parameters, and three more factors, which are 1 at first:
    `bending_ratio`, of the rigidity along the warp over that along the weft; `bending_twist`, of
    that of twist; and `softening`, of the curvature by which bending softens.

    Args:
        material: One of `fabric_names()`, or a fabric.
        mu: Coefficient of friction between cloth and floor, 0 ... 10.
        static_ratio: Coefficient of friction at rest, over `mu`; 1 ... 3.
        density: Factor of the mass per area of the fabric, 0.1 ... 10.
        bending: Factor of its bending rigidity, likewise.
        stretching: Factor of its stretching stiffness, likewise.
        speed: Factor of the speed of the holders, likewise.
        settings: Other arguments of `scene`.
    """
    cloth_fabric = fabric(material) if isinstance(material, str) else material
    mesh = settings.pop("mesh", 41)
    preset = settings.pop("preset", "certified")
    drag = Drag(
        fabric=cloth_fabric, mu=mu, mesh=_square(mesh), preset=preset_named(preset), **settings
    )

    def make(values: Mapping[str, float], hanging: Hang) -> Scene:
        varied = replace(
            drag,
            fabric=cloth_fabric.scaled(**{name: values[name] for name in of_fabric}),
            mu=values["mu"],
            static_ratio=values["static_ratio"],
            speed=values["speed"],
        )
        return varied.scene(hanging)

    of_fabric = {
        "density": density,
        "bending": bending,
        "stretching": stretching,
        "bending_ratio": 1.0,
        "bending_twist": 1.0,
        "softening": 1.0,
    }
    factors = {**of_fabric, "speed": speed}
    return SceneFamily(
        {
            "mu": SceneParameter(mu, 0.0, MU_MAX / static_ratio),
            "static_ratio": SceneParameter(static_ratio, 1.0, STATIC_RATIO_MAX),
            **{name: SceneParameter(value, *FACTORS) for name, value in factors.items()},
        },
        make,
    )


def _of_physics(*, sensitivities: Sequence[str] = (), **physics: Any) -> Scene:
    """Return the scene of physics, differentiated by the parameters that it names."""
    return family(**physics).differentiated(sensitivities)


KIND = cloth_kind(_of_physics)


def motion_of(hung: Hung, floor: Body) -> Callable[[float], tuple[Floats, Sequence[Body]]]:
    """Return the motion over a floor.

    Gravity is upright from one second after the drop on.
    """
    bodies = [floor]

    def motion(time: float) -> tuple[Floats, Sequence[Body]]:
        # The tilt fades out within a second, so that gravity does not jump.
        upright = min(max(time - duration_of(DROP), 0.0), 1.0)
        return np.array([0.0, 0.0, -GRAVITY]) + hung.tilt * GRAVITY * (1.0 - upright), bodies

    return motion


def holder_pose(time: ArrayLike) -> Floats:
    """Return the pose of the holders, relative to their start: ([T,] 3, 4).

    `time` is a time or times [s].
    """
    pose = np.zeros((*np.shape(time), 3, 4))
    pose[..., :3] = np.eye(3)
    # The holders move along x and z only.
    pose[..., ::2, 3] = holder_path(time)
    return pose


def _forces(cloth: Cloth, hung: Hung) -> Record:
    """Return the forces of the floor and of the holders (3,) [N].

    Before the first step the holders bear the weight.
    """
    # The solver has reactions only after a step.
    weight = cloth.masses.sum() * np.array([0.0, 0.0, -GRAVITY])
    holders = cloth.reactions[hung.held].sum(axis=0) if cloth.total.steps else -weight
    return {"contact_force": cloth.contact_force(), "holder_force": holders}


def _labels(run: ClothRun, hung: Hung, cloth_fabric: Fabric) -> dict[str, Any]:
    """Return the labels of a drop: the fabric, the bias, and the side on which the cloth landed.

    `landed_side` is the sign of the mean x of the cloth minus the mean x of the holders, in the
    first frame after the drop. It is 0 if the scene has no such frame.
    """
    frame = int(np.ceil(duration_of(DROP) * FRAME_RATE))
    landed = 0
    if frame < len(run.positions):
        x = run.positions[frame, :, 0]
        landed = int(np.sign(x.mean() - x[hung.held].mean()))
    return {
        **fabric_labels(cloth_fabric),
        "bias_side": hung.side,
        "bias": hung.bias,
        "landed_side": landed,
    }
