"""Bad input is refused by name, and a state that is lost stays lost without a crash."""

import dataclasses
import math

import numpy as np
import pytest

from stickslip_sim_core import PRESETS, Cloth, fabric, plane
from stickslip_sim_core.cloth import meshes

CERTIFIED = PRESETS["certified"]


def mesh_of(rest: list[tuple[float, float]], triangles: list[tuple[int, int, int]]) -> meshes.Mesh:
    return meshes.Mesh(
        np.array(rest, float).reshape(-1, 2), np.array(triangles, np.int32).reshape(-1, 3)
    )


SQUARE = [(0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1)]


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (mesh_of(SQUARE, [(0, 2, 1), (0, 3, 2)]), "triangles: must run counter-clockwise"),
        (mesh_of(SQUARE, [(0, 1, 4)]), "triangles: must index 4 vertices, got 4"),
        (mesh_of(SQUARE, []), "triangles: must not be empty"),
        (
            mesh_of([*SQUARE, (0.05, 1e-6)], [(0, 1, 4), (0, 1, 2), (0, 2, 3)]),
            "triangles: .*slivers",
        ),
        (
            mesh_of([*SQUARE, (0.5, 0.5)], [(0, 1, 2), (0, 2, 3)]),
            "rest: every vertex must belong to a triangle, and 4",
        ),
        (
            mesh_of([*SQUARE[:3], (math.nan, 0.0)], [(0, 1, 2), (0, 2, 3)]),
            "rest: must be finite, and vertex 3 is not",
        ),
        (
            mesh_of([*SQUARE, (0.2, 0.0)], [(0, 1, 2), (0, 2, 3), (0, 4, 2)]),
            r"triangles: edge \(.*\) must belong to at most",
        ),
    ],
)
def test_degenerate_mesh(mesh: meshes.Mesh, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Cloth(mesh, fabric("gray-interlock"), CERTIFIED)


def test_held_outside_the_mesh() -> None:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    with pytest.raises(ValueError, match="held: must index 25 vertices, got 25"):
        Cloth(mesh, fabric("gray-interlock"), CERTIFIED, held=[25])


def test_nan_is_refused() -> None:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = Cloth(mesh, fabric("gray-interlock"), CERTIFIED, held=[0])
    at = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    with pytest.raises(ValueError, match="positions: must be finite"):
        cloth.set_state(np.where(at == at[3], np.nan, at))
    cloth.set_state(at)
    with pytest.raises(ValueError, match="held and gravity: must be finite"):
        cloth.step(0.01, held=[(np.nan, 0.0, 0.0)])
    with pytest.raises(ValueError, match="dt: must be finite and > 0"):
        cloth.step(-0.01, held=at[:1])
    with pytest.raises(ValueError, match=r"damping: must be finite and >= 0 \[1/s\], got -50"):
        cloth.step(0.01, held=at[:1], damping=-50.0)
    with pytest.raises(ValueError, match="end: must be a number, got nan"):
        cloth.advance(math.nan, lambda _: (cloth.gravity, at[:1], []))


def test_lost_state_is_counted_and_does_not_crash() -> None:
    """A solver that is cut off after one iteration, without smaller steps, loses a cloth that is
    torn to pieces.
    """
    mesh = meshes.grid(0.1, 0.1, 6, 6)
    hopeless = dataclasses.replace(CERTIFIED, newton_max=1, halvings_max=0)
    cloth = Cloth(mesh, fabric("gray-interlock"), hopeless)
    at = np.random.default_rng(0).normal(size=(len(mesh.rest), 3))
    floor = plane(
        0.5, origin=(0.0, 0.0, at[:, 2].min() - 0.1)
    )  # a state that begins in a body would be refused
    cloth.set_state(at, 1e160 * at)
    for _ in range(3):
        cloth.step(0.1, bodies=[floor])
    assert cloth.total.unconverged == 3
    assert not cloth.worst_residual < 1.0
