"""Cloth that starts inside a body is refused.

What a body forces out of itself gets no velocity by that.
"""

import numpy as np
import pytest

from stickslip_sim_core import (
    Body,
    Cloth,
    box,
    capsule,
    cylinder,
    fabric,
    plane,
    preset_named,
    sphere,
)
from stickslip_sim_core.cloth import meshes

PATCH = meshes.grid(0.06, 0.06, 6, 6)


def cloth(height: float, held: list[int] | None = None) -> tuple[Cloth, np.ndarray]:
    """A patch at a height [m]."""
    return Cloth(
        PATCH, fabric("gray-interlock"), preset_named("certified"), held=held or []
    ), np.column_stack([PATCH.rest, np.full(len(PATCH.rest), height)])


@pytest.mark.parametrize(
    ("height", "body", "depth"),
    [
        (-0.05, plane(0.5), "50"),
        (-1e-3, plane(0.5), "1"),
        (0.0, sphere(0.5, 0.1), "57.5736"),
        (0.0, box(0.5, (1, 1, 0.04), rounding=0.01), "20"),
    ],
)
def test_starts_inside_a_body_are_refused(height: float, body: Body, depth: str) -> None:
    """They would be thrown out within one step: 1 mm deep at 1 m/s."""
    message = (
        rf"positions: must not start inside a body, and vertex \d+ is {depth} mm inside body 1"
    )
    sheet, start = cloth(height)
    bodies = [plane(0.5, origin=(0.0, 0.0, -1.0)), body]
    with pytest.raises(ValueError, match=message):
        sheet.set_state(start, bodies=bodies)
    sheet, start = cloth(height)
    sheet.set_state(start)
    with pytest.raises(ValueError, match=message):
        sheet.step(0.01, bodies=bodies)


UPRIGHT = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
"""Axes of a rod along y."""


@pytest.mark.parametrize(
    "body",
    [
        box(0.5, (0.018, 0.2, 0.05), rounding=0.009, origin=(0.005, 0.0, 0.0)),
        cylinder(0.5, 0.009, origin=(0.004, 0.006, 0.0)),
        cylinder(0.5, 0.009, origin=(0.005, 0.0, 0.0005), rotation=UPRIGHT),
        capsule(0.5, 0.009, 0.05, origin=(0.004, 0.006, -0.0255)),
        sphere(0.5, 0.009, origin=(0.004, 0.006, -0.001)),
    ],
    ids=["plate", "peg", "rod", "end of a peg", "bead"],
)
def test_the_smallest_bodies_do_not_start_between_vertices(body: Body) -> None:
    """No circle of 0.9 cells is without a vertex, so what goes through cloth has one inside."""
    sheet, start = cloth(0.0)
    with pytest.raises(ValueError, match="positions: must not start inside a body"):
        sheet.set_state(start, bodies=[body])


@pytest.mark.parametrize(
    "body",
    [
        plane(0.5),
        box(0.5, (0.018, 0.2, 0.05), rounding=0.009, origin=(0.005, 0.0, -0.025)),
        box(0.5, (0.3, 0.3, 0.05), rounding=0.01, origin=(0.005, 0.0, -0.025)),
        cylinder(0.5, 0.009, origin=(0.005, 0.0, -0.009), rotation=UPRIGHT),
        sphere(0.5, 0.009, origin=(0.004, 0.006, -0.009)),
        sphere(0.5, 0.04, origin=(0.0, 0.0, -0.04)),
    ],
)
def test_starts_on_a_body_are_not(body: Body) -> None:
    sheet, start = cloth(0.0)
    sheet.set_state(start, bodies=[body])


def test_what_is_let_go_inside_a_body_gets_no_velocity_by_that() -> None:
    """A holder pushes a corner 1 mm into the floor and lets go: it comes out at once, and stays on
    the floor.
    """
    sheet, start = cloth(0.0, held=[0])
    sheet.set_state(start, bodies=[plane(0.5)])
    for step in range(1, 11):
        sheet.step(0.01, held=start[[0]] - [0.0, 0.0, 1e-4 * step], bodies=[plane(0.5)])
    sheet.hold([], bodies=[plane(0.5)])
    for _ in range(3):
        sheet.step(0.001, bodies=[plane(0.5)])
        assert np.abs(sheet.velocities[:, 2]).max() < 0.05
    assert sheet.positions[:, 2].min() > -1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": (0.0, np.nan, 0.0)}, "origin: must be three finite numbers"),
        (
            {"rotation": 2.0 * np.eye(3)},
            r"rotation: must be orthonormal \(3, 3\) with determinant \+1",
        ),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "rotation: must be orthonormal"),
        ({"rotation": np.full((3, 3), np.nan)}, "rotation: must be orthonormal"),
        ({"rotation": np.eye(2)}, "rotation: must be orthonormal"),
    ],
)
def test_bodies_must_be_placed(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Body(0.5, **change)  # type: ignore[arg-type]


def test_a_plane_has_a_normal() -> None:
    with pytest.raises(ValueError, match="normal: must be three finite numbers, not all 0"):
        plane(0.5, normal=(0.0, 0.0, 0.0))


def test_a_sheet_of_100_m_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="mesh: must be at most 20 m long and wide, got 100 m"):
        Cloth(meshes.grid(100.0, 1.0, 10, 10), fabric("gray-interlock"), preset_named("certified"))
