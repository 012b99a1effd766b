"""Everyday scenes of cloth with a known answer or bound.

Each is right, refused, or not valid for the true reason.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.cloth.contact import Body, box, cylinder, plane, sphere
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

SIDE = 0.1
"""Of the napkin [m]."""

ALONG_Y = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Axes of a rod along y."""

Bodies = Callable[[float], list[Body]]


class Hands(NamedTuple):
    """Vertices that are held, and their positions at a time, from those at the start."""

    held: ArrayLike
    path: Callable[[Floats, float], Floats] = lambda start, _: start


NO_HANDS = Hands(())


def _run(
    cells: int,
    bodies: Bodies,
    *,
    height: float = 1e-3,
    seconds: float = 0.2,
    hands: Hands = NO_HANDS,
    fps: float = 50.0,
    damping: float = 0.0,
    turn: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
) -> tuple[str, Cloth]:
    mesh = meshes.grid(SIDE, SIDE, cells, cells)
    held = np.asarray(hands.held, int)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"), held=held)
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), height)]) @ np.asarray(turn).T
    cloth.set_state(start, bodies=bodies(0.0))
    for frame in range(1, round(seconds * fps) + 1):
        cloth.advance(
            frame / fps,
            lambda t: (cloth.gravity, hands.path(start[held], t), bodies(t)),
            damping=lambda _: damping,
        )
    return checks.failed(checks.values(checks.Seen(cloth, cloth.positions[None], 0)))[0], cloth


def _rim(cells: int) -> Floats:
    x, y = np.abs(meshes.grid(SIDE, SIDE, cells, cells).rest.T)
    return np.flatnonzero(np.maximum(x, y) > 0.499 * SIDE).astype(float)


def napkin_on_floor(cells: int) -> str:
    """The floor bears the weight within 5 %."""
    code, cloth = _run(cells, lambda _: [plane(0.5)], seconds=0.4)
    share = cloth.contact_force()[2] / (cloth.masses.sum() * GRAVITY)
    return code or (
        "right" if abs(share - 1.0) < 0.05 else f"wrong: bears {share:.3g} of the weight"
    )


def _caught(cells: int, bodies: Bodies) -> str:
    """The middle of a napkin that falls stays above z = 0."""
    code, cloth = _run(cells, bodies, height=0.02, seconds=0.25)
    middle = cloth.positions[len(cloth.positions) // 2, 2]
    return code or ("right" if middle > 0.0 else f"wrong: the middle is at {middle:.3g} m")


def _refused(cells: int, bodies: Bodies, *, height: float = 0.02) -> str:
    try:
        return _run(cells, bodies, height=height)[0]
    except ValueError:
        return "refused"


def rod_of_a_cell(cells: int) -> str:
    """A rod whose radius is a cell carries the napkin."""
    return _caught(cells, lambda _: [cylinder(1.0, SIDE / cells, rotation=ALONG_Y)])


def ball_of_a_cell(cells: int) -> str:
    """A ball whose radius is a cell carries the napkin."""
    return _caught(cells, lambda _: [sphere(5.0, SIDE / cells)])


def rod_of_a_quarter(cells: int) -> str:
    """A rod with a radius of a quarter of a cell is too sharp."""
    return _refused(cells, lambda _: [cylinder(1.0, 0.25 * SIDE / cells, rotation=ALONG_Y)])


def rod_of_half(cells: int) -> str:
    """A rod with a radius of just over half a cell is too sharp."""
    return _refused(cells, lambda _: [cylinder(1.0, 0.51 * SIDE / cells, rotation=ALONG_Y)])


def wide_rod(cells: int) -> str:
    """A rod with a radius of ten cells carries the napkin."""
    radius = 10.0 * SIDE / cells
    return _caught(
        cells, lambda _: [cylinder(1.0, radius, origin=[0.0, 0.0, 0.01 - radius], rotation=ALONG_Y)]
    )


def table_corner(cells: int) -> str:
    """The rounded corner of a table carries the middle of a napkin that falls on it."""
    return _caught(
        cells, lambda _: [box(1.0, [0.2, 0.2, 0.1], rounding=0.0128, origin=[0.08, 0.08, -0.045])]
    )


def _thrown(cells: int, speed: float) -> str:
    """A ball of two cells, thrown by 0.2 m, does not pass through a held napkin unseen.

    It starts 5 cm below the napkin.
    """
    radius = 2.0 * SIDE / cells

    def bodies(t: float) -> list[Body]:
        return [sphere(0.5, radius, origin=[0.0, 0.0, -radius - 0.05 + speed * t])]

    rim = _rim(cells).astype(int)
    code, cloth = _run(cells, bodies, seconds=0.2 / speed, hands=Hands(rim), fps=50.0 * speed)
    middle = cloth.positions[len(cloth.positions) // 2, 2]
    return code or (
        "right"
        if middle > 0.1
        else f"wrong: the ball went through, the middle is at {middle:.3g} m"
    )


def thrown_ball(cells: int) -> str:
    """At 10 m/s."""
    return _thrown(cells, 10.0)


def pushed_ball(cells: int) -> str:
    """At 1 m/s."""
    return _thrown(cells, 1.0)


def paddle(cells: int) -> str:
    """A floor that turns by 20 rad/s for 0.05 s throws no vertex too fast.

    The limit is twice the largest speed of the floor.
    """

    def bodies(t: float) -> list[Body]:
        return [
            plane(0.0, origin=[-0.06, 0.0, 0.0], normal=[-np.sin(20.0 * t), 0.0, np.cos(20.0 * t)])
        ]

    code, cloth = _run(cells, bodies, seconds=0.05, height=1e-6)
    speed = float(np.linalg.norm(cloth.velocities, axis=1).max())
    return code or ("right" if speed < 2.0 * 20.0 * 0.12 else f"wrong: thrown at {speed:.3g} m/s")


def holders_into_floor(cells: int) -> str:
    """Held vertices go 5 cm under the floor."""
    return _run(
        cells,
        lambda _: [plane(0.5)],
        height=0.01,
        hands=Hands([0, cells], lambda start, t: start - np.array([0.0, 0.0, 0.3 * t])),
    )[0]


def hanging(cells: int) -> str:
    """Two held corners bear the weight within 5 %."""
    code, cloth = _run(cells, lambda _: [], hands=Hands([0, cells]), seconds=1.0, damping=10.0)
    share = cloth.reactions[cloth.held, 2].sum() / (cloth.masses.sum() * GRAVITY)
    return code or (
        "right" if abs(share - 1.0) < 0.05 else f"wrong: holders bear {share:.3g} of the weight"
    )


def lifted(cells: int) -> str:
    """A floor that rises with 5 m/s^2 bears 1 + 5 / g of the weight within 5 %."""
    code, cloth = _run(
        cells, lambda t: [plane(0.5, origin=[0.0, 0.0, 2.5 * t * t])], height=1e-6, seconds=1.0
    )
    share = cloth.contact_force()[2] / (cloth.masses.sum() * (GRAVITY + 5.0))
    return code or (
        "right" if abs(share - 1.0) < 0.05 else f"wrong: bears {share:.3g} of what it should"
    )


def _on_incline(cells: int, mu: float) -> tuple[str, float]:
    """Return the code, and the mean acceleration down an incline of 30 degrees [m/s^2]."""
    tilt = np.array(
        [[np.cos(np.pi / 6), 0.0, 0.5], [0.0, 1.0, 0.0], [-0.5, 0.0, np.cos(np.pi / 6)]]
    )
    code, cloth = _run(cells, lambda _: [plane(mu, normal=tilt[:, 2])], height=1e-6, turn=tilt)
    return code, float(cloth.velocities.mean(axis=0) @ tilt[:, 0]) / cloth.time


def slides_down(cells: int) -> str:
    """At mu 0.2 it accelerates by g (sin - mu cos) within 5 %."""
    code, acceleration = _on_incline(cells, 0.2)
    expected = GRAVITY * (0.5 - 0.2 * np.cos(np.pi / 6))
    return code or (
        "right"
        if abs(acceleration / expected - 1.0) < 0.05
        else f"wrong: {acceleration:.3g} m/s^2, not {expected:.3g}"
    )


def sticks(cells: int) -> str:
    """At mu 0.7 nothing slides."""
    code, acceleration = _on_incline(cells, 0.7)
    return code or (
        "right" if abs(acceleration) < 1e-3 else f"wrong: slides with {acceleration:.3g} m/s^2"
    )


def slides_into_corner(cells: int) -> str:
    """A corner of a floor and two walls carries the corner of a napkin within 5 %.

    It is turned until all three bear.
    """
    along, up = np.array([1.0, -1.0, 0.0]) / 2.0, np.array([-1.0, -1.0, 1.0]) / 6.0**0.5
    axes = np.column_stack([up - along, up + along, np.array([1.0, 1.0, 2.0]) / 6.0**0.5])
    code, cloth = _run(
        cells,
        lambda _: [
            plane(0.1, normal=axis, origin=-0.055 * axis * (i < 2)) for i, axis in enumerate(axes.T)
        ],
        height=1e-4,
        seconds=1.0,
        damping=2.0,
        turn=axes,
    )
    share = cloth.contact_force()[2] / (cloth.masses.sum() * GRAVITY)
    nearest = float((cloth.positions @ axes[:, :2]).max(axis=1).min() + 0.055)
    if abs(share - 1.0) > 0.05 or not 0.0 < nearest < 1e-3:
        return code or f"wrong: bears {share:.3g} of the weight, {nearest:.3g} m from the walls"
    return code or "right"


def stretched_rim(cells: int) -> str:
    """A rim that grows by 40 %."""
    rim = _rim(cells).astype(int)
    hands = Hands(rim, lambda start, t: start * (1.0 + 2.0 * t))
    return _run(cells, lambda _: [], hands=hands)[0]


def start_in_floor(cells: int) -> str:
    """A napkin that starts 5 cm under the floor."""
    return _refused(cells, lambda _: [plane(0.5)], height=-0.05)


def start_in_ball(cells: int) -> str:
    """A napkin that starts through the middle of a ball."""
    return _refused(cells, lambda _: [sphere(0.5, 0.03)], height=0.005)


def shaken_floor(cells: int) -> str:
    """A floor that shakes at 8 Hz, filmed at 10 and at 100 frames a second, moves cloth alike."""

    def bodies(t: float) -> list[Body]:
        return [plane(1.0, origin=[2e-3 * np.sin(16.0 * np.pi * t), 0.0, 0.0])]

    runs = [_run(cells, bodies, seconds=0.2, fps=fps) for fps in (10.0, 100.0)]
    off = float(np.abs(runs[0][1].positions_at(0.2) - runs[1][1].positions_at(0.2)).max())
    return runs[0][0] or ("right" if off < 1e-5 else f"wrong: off by {off:.3g} m")


def shaken_from_rest(cells: int) -> str:
    """A floor that begins to shake after 0.5 s takes the cloth along within 5 %.

    Its period is the longest step.
    """

    def bodies(t: float) -> list[Body]:
        return [
            plane(1.0, origin=[1e-3 * (1.0 - np.cos(16.0 * np.pi * max(t - 0.5, 0.0))), 0.0, 0.0])
        ]

    code, cloth = _run(cells, bodies, seconds=0.5625, height=1e-6, fps=16.0)
    way = float(
        (cloth.positions_at(0.5625) - np.pad(cloth.mesh.rest, ((0, 0), (0, 1))))[:, 0].mean()
    )
    return code or ("right" if abs(way / 2e-3 - 1.0) < 0.05 else f"wrong: goes {way:.3g} m of 2 mm")


def jumping_floor(cells: int) -> str:
    """A floor that is 1 cm higher from one instant to the next."""
    return _run(cells, lambda t: [plane(0.5, origin=[0.0, 0.0, 0.01 * (t > 0.15)])], height=1e-6)[0]


def jumping_holder(cells: int) -> str:
    """A holder that is 1 cm further from one instant to the next."""
    hands = Hands([0, cells], lambda start, t: start + 0.01 * (t > 0.15))
    return _run(cells, lambda _: [], hands=hands)[0]


def squeezed(cells: int) -> str:
    """Two blocks close on a napkin until they cross."""

    def bodies(t: float) -> list[Body]:
        return [
            plane(0.5),
            box(0.5, [0.2, 0.2, 0.1], rounding=0.04, origin=[0.0, 0.0, 0.06 - 0.2 * t]),
        ]

    return _run(cells, bodies, seconds=0.15)[0]


EVERYDAY: Mapping[str, tuple[Callable[[int], str], tuple[str, ...]]] = MappingProxyType(
    {
        make_scene.__name__: (make_scene, allowed)
        for make_scene, allowed in (
            (napkin_on_floor, ("right",)),
            (rod_of_a_cell, ("right",)),
            (ball_of_a_cell, ("right",)),
            (rod_of_a_quarter, ("refused",)),
            (rod_of_half, ("refused",)),
            (wide_rod, ("right",)),
            (table_corner, ("right",)),
            (hanging, ("right",)),
            (lifted, ("right",)),
            (slides_down, ("right",)),
            (sticks, ("right",)),
            (slides_into_corner, ("right",)),
            (paddle, ("right",)),
            (pushed_ball, ("right", "stretch")),
            (thrown_ball, ("right", "stretch", "penetration", "passages")),
            (holders_into_floor, ("penetration", "stretch")),
            (stretched_rim, ("stretch",)),
            (start_in_floor, ("refused", "contact_gain")),
            (start_in_ball, ("refused", "contact_gain", "penetration", "stretch")),
            (shaken_floor, ("right",)),
            (shaken_from_rest, ("right",)),
            (jumping_floor, ("jumps",)),
            (jumping_holder, ("jumps",)),
            (squeezed, ("penetration", "contact_gain", "passages", "unconverged", "budget")),
        )
    }
)
"""Scenes by name, and what may come of them: "right", "refused", or the code of a check."""
