"""A square of cloth on a sphere that turns [thesis, 4.6]."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core import cloth, fabrics, meshes
from stickslip_sim_core.presets import Preset, preset_named

Floats = NDArray[np.float64]

SIDE = 0.2
"""Side of the square of cloth [m]."""

RADIUS = 0.05
"""Of the sphere, which stands on the floor [m]."""

CLEARANCE = 0.005
"""Height of the cloth over the sphere at the start [m]."""

SETTLING = 2.0
"""Time before the sphere begins to turn [s], and the time over which it then gains its speed."""

SPEED = 1.0
"""Of the sphere about its vertical axis [rad/s]."""

BIAS = 1e-3
"""Horizontal over vertical gravity at most until the sphere turns, drawn from the seed, to break the symmetry."""


@dataclass(frozen=True, eq=False)
class RotatingSphere:
    """A cloth that fell on a sphere which then turned. World axes: z up, the floor is z = 0, the sphere's axis is z."""

    positions: Floats
    """(frames, V, 3) [m]"""

    rest: Floats
    """(V, 2) [m]"""

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: Floats
    """(frames,) [s]"""

    angle: Floats
    """(frames,): by which the sphere has turned [rad]."""

    contacts: NDArray[np.int32]
    """(frames, V): 0 on the floor, 1 on the sphere, -1 on neither."""

    bias: tuple[float, float]
    """Horizontal over vertical gravity (x, y) until the sphere turns."""

    steps: int
    unconverged_steps: int
    worst_residual: float
    """Largest residual force of a node in any step, in weights of a node."""

    valid: bool
    reason: str
    """Why it is not valid, or empty."""


def turned(time: float) -> float:
    """Return the angle by which the sphere has turned [rad]: at rest at first, then evenly faster, then at `SPEED`."""
    t = max(time - SETTLING, 0.0)
    return SPEED * (0.5 * t * t / SETTLING if t < SETTLING else t - 0.5 * SETTLING)


def rotating_sphere(
    material: str,
    mu_floor: float,
    mu_sphere: float,
    *,
    preset: str | Preset = "certified",
    vertices: int = 41,
    frames: int = 150,
    frame_rate: float = 15.0,
    seed: int = 0,
) -> RotatingSphere:
    """Drop a square of cloth on a sphere that stands on the floor, and turn the sphere, which drags it [thesis, 4.6].

    The cloth falls from rest, flat and centred, and drapes over the sphere until its hem lies on the floor.

    Args:
        material: One of `fabric_names()`.
        mu_floor: Coefficient of friction between cloth and floor, >= 0.
        mu_sphere: Between cloth and sphere.
        preset: Solver settings, or their name.
        vertices: Vertices a side of the mesh, at least 5.
        frames: Frames to simulate, from time 0 on.
        frame_rate: Frames a second.
        seed: Of the bias.

    Raises:
        ValueError: An argument breaks its rule.
    """
    settings = preset_named(preset)
    if frames < 1:
        raise ValueError(f"frames: must be at least 1, got {frames}")
    if vertices < 5:
        raise ValueError(f"vertices: must be at least 5, got {vertices}")
    if not (np.isfinite(frame_rate) and frame_rate > 0.0):
        raise ValueError(f"frame_rate: must be finite and > 0, got {frame_rate}")
    for name, mu in (("mu_floor", mu_floor), ("mu_sphere", mu_sphere)):
        if not (np.isfinite(mu) and mu >= 0.0):
            raise ValueError(f"{name}: must be finite and >= 0, got {mu}")
    sheet = meshes.grid(SIDE, SIDE, vertices - 1, vertices - 1)
    simulated = cloth.Cloth(sheet, fabrics.fabric(material), settings)
    simulated.set_state(np.column_stack([sheet.rest, np.full(len(sheet.rest), 2.0 * RADIUS + CLEARANCE)]))
    bias = np.random.default_rng(seed).uniform(-BIAS, BIAS, 2)
    floor = cloth.plane(mu_floor)

    per_frame = int(np.ceil(1.0 / (frame_rate * settings.time_step)))
    dt = 1.0 / (frame_rate * per_frame)
    positions, contacts = [simulated.positions], [simulated.contacts]
    for frame in range(1, frames):
        for step in range(1, per_frame + 1):
            time = ((frame - 1) * per_frame + step) * dt
            simulated.gravity[:, :2] = bias * cloth.GRAVITY * (time < SETTLING)
            c, s = np.cos(turned(time)), np.sin(turned(time))
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            ball = cloth.sphere(mu_sphere, RADIUS, origin=(0.0, 0.0, RADIUS), rotation=turn)
            simulated.step(dt, bodies=[floor, ball])
        positions.append(simulated.positions)
        contacts.append(simulated.contacts)
        if not np.isfinite(positions[-1]).all():
            break
    path = np.stack(positions)
    times = np.arange(len(path)) / frame_rate
    reason = simulated.why_invalid(path)
    return RotatingSphere(
        positions=path,
        rest=sheet.rest,
        triangles=sheet.triangles,
        times=times,
        angle=np.array([turned(float(t)) for t in times]),
        contacts=np.stack(contacts),
        bias=(float(bias[0]), float(bias[1])),
        steps=simulated.steps,
        unconverged_steps=simulated.unconverged_steps,
        worst_residual=simulated.worst_residual,
        valid=not reason,
        reason=reason,
    )
