"""How many iterations Newton's method takes where friction turns and follows the normal force.

The counts are of the portable kernels, and repeat exactly. Without the share of friction in
Newton's matrix, the sphere takes ten times as many. Without its share in what contact prescribes,
the shaken floor takes a fifth more. Results stay right in both cases; only the cost grows. So they
do where cloth slides over cloth.
"""

import numpy as np
import pytest
from stickslip_testing.drums import OverCloth

from stickslip_sim_core import Cloth, SelfContact, fabric, plane, preset_named, sphere
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import THICKNESS

pytestmark = pytest.mark.physics


def _cloth(cells: int, height: float, held: bool = False, kernel: str | None = "baseline") -> Cloth:
    mesh = meshes.grid(0.2, 0.2, cells, cells)
    edge = np.flatnonzero(mesh.rest[:, 0] < -0.0999) if held else np.array([], dtype=int)
    cloth = Cloth(
        mesh, fabric("gray-interlock"), preset_named("certified"), held=edge, kernel=kernel
    )
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), height)]))
    return cloth


def test_on_a_sphere_that_turns() -> None:
    """Measured: 1,042; without friction's share in the matrix: 11,122."""
    cloth = _cloth(10, 0.105)
    for step in range(60):
        angle = 0.05 * max(step - 25, 0)
        c, s = np.cos(angle), np.sin(angle)
        ball = sphere(
            1.0,
            0.05,
            origin=(0.0, 0.0, 0.05),
            rotation=[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
        )
        cloth.step(0.02, bodies=[plane(1.0), ball])
    assert cloth.total.unconverged == 0
    assert cloth.total.newton < 3000


def test_on_a_floor_that_is_shaken() -> None:
    """Measured: 167; without friction's share in what contact prescribes: 204."""
    spent = 0
    for held in (True, False):
        cloth = _cloth(8, 0.0, held)
        start = cloth.positions
        cloth.set_state(start, bodies=[plane(1.0)])  # the floor is here before it moves
        for step in range(1, 41):
            time = 0.02 * step
            rise = 0.01 * np.sin(8.0 * time)
            slide = time if held else 0.25 * np.sin(20.0 * time)
            floor = plane(1.0, origin=(slide, 0.0, rise))
            cloth.step(0.02, held=start[cloth.held] + np.array([0.0, 0.0, rise]), bodies=[floor])
        assert cloth.total.unconverged == 0
        spent += cloth.total.newton
    assert spent < 186


def test_with_a_factor_of_half_precision() -> None:
    """Measured: 290 iterations of GMRES; in single precision, which portable kernels keep: 269."""
    half, single = _cloth(80, 1e-3, held=True, kernel=None), _cloth(80, 1e-3, held=True)
    if half.kernel == "baseline":
        pytest.skip("this processor has no half precision")
    for _ in range(8):
        for cloth in (half, single):
            cloth.step(0.02, held=cloth.positions[cloth.held], bodies=[plane(0.5)])
    assert half.total.unconverged == 0
    assert single.total.krylov < half.total.krylov < 1.2 * single.total.krylov
    assert half.positions == pytest.approx(single.positions, abs=1e-6)


def test_over_a_curved_cloth() -> None:
    """Measured: 5.1 a step.

    Where edges of both bear, too: 13.3; with pairs as stiff along normals as across: 11.3.
    """
    strip = OverCloth(0.5, 0.05, preset_named("certified"), 120)
    strip.draw()
    assert strip.cloth.total.unconverged == 0
    assert strip.iterations < 9


def test_over_a_flat_cloth() -> None:
    """Measured: 30 in 30 steps; where vertices of both bear: 62; where edges do, too: 98."""
    sheet, below = meshes.grid(0.1, 0.1, 10, 10), meshes.grid(0.16, 0.12, 14, 11)
    held = np.flatnonzero(sheet.rest[:, 0] > 0.0499)
    rim = len(sheet.rest) + np.flatnonzero(
        (np.abs(below.rest) > np.abs(below.rest).max(axis=0) - 1e-9).any(axis=1)
    )
    cloth = Cloth(
        meshes.together(sheet, below),
        fabric("gray-interlock"),
        preset_named("certified"),
        held=np.append(held, rim),
        self_contact=SelfContact(0.5, bearing="first"),
        kernel="baseline",
    )
    start = np.concatenate(
        [
            np.column_stack([sheet.rest, np.full(len(sheet.rest), THICKNESS)]),
            np.pad(below.rest, ((0, 0), (0, 1))),
        ]
    )
    cloth.set_state(start)
    for step in range(1, 41):
        ends = start[cloth.held]
        ends[: len(held), 0] += 2e-4 * step
        cloth.step(0.02, held=ends, bodies=[plane(0.5)])
        if step == 10:
            settled = cloth.total.newton
    assert cloth.total.unconverged == 0
    assert cloth.total.newton - settled < 45
