"""Checks of runs: each catches a run that is wrong, and names itself.

Its values are those of the geometry.
"""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.cloth.contact import Body, box, capsule, cylinder, plane, sphere
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import Cloth

SIDE, CELLS = 0.1, 5
HELD = range((CELLS + 1) ** 2 - 1)  # all but a corner


def judged(cloth: Cloth, crossings: int = 0) -> tuple[str, str]:
    return checks.failed(checks.values(checks.Seen(cloth, cloth.positions[None], crossings)))


def sheet(height: float, held: ArrayLike = ()) -> tuple[Cloth, np.ndarray]:
    mesh = meshes.grid(SIDE, SIDE, CELLS, CELLS)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"), held=held)
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), height)])
    cloth.set_state(start)
    return cloth, start


def gradients(cloth: Cloth) -> Floats:
    """Return the deformation gradients (T, 3, 2)."""
    triangles, rest, at = np.asarray(cloth.mesh.triangles), cloth.mesh.rest, cloth.positions
    before, after = (
        np.moveaxis(x[triangles[:, 1:]] - x[triangles[:, :1]], 1, 2) for x in (rest, at)
    )
    gradient: Floats = after @ np.linalg.inv(before)
    return gradient


def moved(height: float, by: ArrayLike, bodies: list[Body], held: ArrayLike = HELD) -> Cloth:
    """A sheet after one step, in which its held vertices move."""
    cloth, start = sheet(height, held)
    cloth.step(0.01, held=(start + np.asarray(by))[np.asarray(held)], bodies=bodies)
    return cloth


def test_a_sheet_on_a_floor_passes_all() -> None:
    cloth, _ = sheet(1e-4)
    for _ in range(20):
        cloth.step(0.01, bodies=[plane(0.5)])
    assert judged(cloth) == ("", "")
    worst = checks.values(checks.Seen(cloth, cloth.positions[None], 0))
    assert worst["stretch"] == pytest.approx(1.0, abs=1e-3)
    assert worst["contact_gain"] < 1e-9
    assert worst["energy_gain"] < 1e-9


def test_stretch_is_the_largest_principal_one() -> None:
    """The held triangles are stretched by 1.3.

    Those at the free corner, which stays behind, a little more.
    """
    cloth, start = sheet(0.0, HELD)
    cloth.step(0.01, held=(start * [1.3, 0.9, 1.0])[:-1])
    largest = np.sort([np.linalg.norm(gradient, 2) for gradient in gradients(cloth)])
    assert largest[1:-2] == pytest.approx(1.3, abs=1e-9)
    assert cloth.total.seen.stretch == pytest.approx(largest[-1], rel=1e-9)
    assert 1.3 < cloth.total.seen.stretch < 1.4
    code, text = judged(cloth)
    assert code == "stretch"
    assert text.startswith("stretch: must be at most 1.25, got 1.3")


def test_holders_in_the_floor_are_deep() -> None:
    cloth = moved(0.005, [0.0, 0.0, -0.009], [plane(0.5)])
    assert cloth.total.seen.depth == pytest.approx(0.004 / (SIDE / CELLS))
    assert judged(cloth)[0] == "penetration"


def test_round_bodies_may_be_as_deep_as_flat_triangles_let_them() -> None:
    """The corners of the middle cell are on the ball."""
    cell, radius = SIDE / CELLS, 0.05
    height = math.sqrt(radius**2 - cell**2 / 2.0)
    cloth = moved(height, np.zeros(3), [sphere(0.5, radius)])
    assert cloth.total.seen.depth < 1e-9
    assert moved(height - 0.003, np.zeros(3), [sphere(0.5, radius)]).total.seen.depth > 0.1


@pytest.mark.parametrize(
    "body",
    [
        sphere(0.5, 0.05, origin=[0.003, 0.005, 0.0]),
        cylinder(0.5, 0.05, rotation=[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        capsule(0.5, 0.05, 0.06, origin=[0.003, 0.005, 0.0]),
        box(0.5, [0.12, 0.14, 0.1], rounding=0.05),
        box(0.5, [0.4, 0.4, 0.1], rounding=0.05),
    ],
    ids=["ball", "rod", "upright capsule", "plate", "wide plate"],
)
def test_cloth_that_goes_through_a_body_passes_its_core(body: Body) -> None:
    cloth = moved(0.1, [0.0, 0.0, -0.2], [body])
    assert cloth.total.seen.passages > 0
    assert judged(cloth)[0]
    assert moved(0.1, [0.0, 0.0, 0.04], [body]).total.seen.passages == 0


def test_a_body_that_goes_through_cloth_is_caught() -> None:
    cloth, start = sheet(0.0, HELD)
    cloth.step(0.01, held=start[:-1], bodies=[sphere(0.5, 0.05, origin=[0.003, 0.005, 0.1])])
    cloth.step(0.01, held=start[:-1], bodies=[sphere(0.5, 0.05, origin=[0.003, 0.005, -0.1])])
    assert judged(cloth)[0] == "penetration"  # in a part of the step


def test_what_is_no_number_and_what_crosses_is_named() -> None:
    cloth, _ = sheet(0.0)
    cloth.step(0.01)
    assert judged(cloth, crossings=2)[0] == "crossings"
    worst = dict(checks.values(checks.Seen(cloth, np.full((1, 3, 3), np.nan), 0)))
    assert checks.failed(worst)[0] == "not_finite"
    good = {**worst, "not_finite": 0.0}
    assert checks.failed({**good, "stretch": math.nan})[0] == "stretch"
    assert checks.failed({**good, "contact_gain": 0.08})[0] == "contact_gain"


def test_the_reason_is_the_cause_and_not_what_follows() -> None:
    """A holder driven through a floor stretches the cloth, and no step fits its jerks."""
    cloth, _ = sheet(0.0)
    good = dict(checks.values(checks.Seen(cloth, cloth.positions[None], 0)))
    assert checks.failed({**good, "stretch": 6.4, "penetration": 6.4})[0] == "penetration"
    assert checks.failed({**good, "stretch": 6.4, "passages": 1.0})[0] == "passages"
    assert checks.failed({**good, "stretch": 2.9, "friction_error": 0.5})[0] == "stretch"
    assert checks.failed({**good, "energy_gain": 1.0})[0] == "", "recorded, and not judged"
