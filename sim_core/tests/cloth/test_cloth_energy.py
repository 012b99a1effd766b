"""Energies of a cloth: derivatives by finite differences, what costs nothing, and plates."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import Cloth, Fabric, _testing, fabric, isotropic, preset_named
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.protocols.protocol import DIAGONALS, LENGTH, MeshKind, strip

Floats = NDArray[np.float64]

SHEET = isotropic(0.2, 50.0, 1e-5, 0.3)
MESHES = {
    "grid": meshes.grid(0.04, 0.05, 4, 5),
    "random": meshes.grid(0.04, 0.05, 4, 5, "random", 2),
    "unstructured": meshes.unstructured(0.04, 0.05, 0.01, 1),
}


def cloth_of(mesh: Mesh, material: Fabric = SHEET) -> Cloth:
    return Cloth(mesh, material, preset_named("certified"))


def energy(cloth: Cloth, at: Floats) -> tuple[float, float, Floats]:
    membrane, bending, gradient = cloth._solver.energies(at)
    return membrane, bending, np.asarray(gradient)


def total(cloth: Cloth, at: Floats) -> float:
    return sum(energy(cloth, at)[:2])


def flat(mesh: Mesh) -> Floats:
    return np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])


def waved(mesh: Mesh) -> Floats:
    """Bent and stretched by a few per cent, with no symmetry."""
    x, y = mesh.rest.T
    noise = np.random.default_rng(0).normal(0.0, 1e-4, (len(x), 3))
    return (
        np.column_stack([1.03 * x + 0.1 * y, 0.98 * y, 0.01 * np.sin(100.0 * x + 60.0 * y)]) + noise
    )


def folded(mesh: Mesh) -> Floats:
    """Folded back over a cylinder whose radius is less than a cell: nearly 180 degrees over one
    edge.
    """
    x, y = mesh.rest.T
    radius = 0.002
    angle = np.clip(y / radius, 0.0, np.pi)
    beyond = np.maximum(y - np.pi * radius, 0.0)
    noise = np.random.default_rng(1).normal(0.0, 1e-4, (len(x), 3))
    at = np.column_stack(
        [x, np.minimum(y, 0.0) + radius * np.sin(angle) - beyond, radius * (1.0 - np.cos(angle))]
    )
    return at + noise


SOFT = {
    "isotropic": replace(SHEET, softening=100.0),
    # Its twist is soft, and warp and weft are unlike.
    "orthotropic": replace(
        SHEET, rigidity=np.diag([2e-5, 4e-6, 1e-6]), softening=150.0, name="orthotropic"
    ),
}
"""Fabrics whose rigidity falls with curvature."""


def fabric_of(name: str) -> Fabric:
    of_tests = {"isotropic": SHEET, **{f"soft {name}": soft for name, soft in SOFT.items()}}
    return of_tests[name] if name in of_tests else fabric(name)


STATES: dict[str, Callable[[Mesh], Floats]] = {"flat": flat, "waved": waved, "folded": folded}


@pytest.mark.parametrize(
    "material", ["isotropic", "gray-interlock", "soft isotropic", "soft orthotropic"]
)
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("name", MESHES)
def test_gradient(name: str, state: str, material: str) -> None:
    """Of the table's law, too, whose third derivative jumps at no strain: differences are small
    there.
    """
    mesh = MESHES[name]
    cloth = cloth_of(mesh, fabric_of(material))
    at = STATES[state](mesh)
    gradient = energy(cloth, at)[2]
    rng = np.random.default_rng(2)
    for _ in range(4):
        direction = rng.normal(size=at.shape)
        h = 1e-8 if state == "flat" else 1e-7
        ends = [total(cloth, at + sign * h * direction) for sign in (2.0, 1.0, -1.0, -2.0)]
        difference = (-ends[0] + 8.0 * ends[1] - 8.0 * ends[2] + ends[3]) / (12.0 * h)
        scale = float(np.linalg.norm(gradient)) + 1e-6
        assert float((gradient * direction).sum()) == pytest.approx(
            difference, abs=2e-6 * scale, rel=2e-6
        )


@pytest.mark.parametrize(
    ("material", "state"),
    [
        ("isotropic", "flat"),
        *(
            (material, state)
            for material in (
                "isotropic",
                "navy-sparkle-sweat",
                "soft isotropic",
                "soft orthotropic",
            )
            for state in ("waved", "folded")
        ),
    ],
)
@pytest.mark.parametrize("name", MESHES)
def test_matrix(name: str, state: str, material: str) -> None:
    """The matrix, in single precision, is the gradient's derivative and symmetric, folded by 180
    degrees, too.
    """
    mesh = MESHES[name]
    of = fabric_of(material)
    cloth = cloth_of(mesh, of)
    at = STATES[state](mesh)
    rng = np.random.default_rng(3)
    v, w = rng.normal(size=at.shape), rng.normal(size=at.shape)
    h = 3e-9
    ends = [energy(cloth, at + times * h * v)[2] for times in (2.0, 1.0, -1.0, -2.0)]
    difference = (-ends[0] + 8.0 * ends[1] - 8.0 * ends[2] + ends[3]) / (12.0 * h)
    sheet = mesh.rest, mesh.triangles, of.density, of.stretching, of.rigidity
    soft = of.softening or 0.0
    Kv, Kw = (np.asarray(_testing.stiffness_times(*sheet, at, u, soft)) for u in (v, w))
    assert np.linalg.norm(Kv - difference) < 1e-6 * np.linalg.norm(difference)
    assert float((Kv * w).sum()) == pytest.approx(float((Kw * v).sum()), rel=1e-5)


def rotation(seed: int) -> Floats:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0.0 else -q


@pytest.mark.parametrize("name", MESHES)
def test_rigid_motions_cost_nothing(name: str) -> None:
    mesh = MESHES[name]
    cloth = cloth_of(mesh)
    turn = rotation(5)
    moved = flat(mesh) @ turn.T + [0.3, -0.2, 0.5]
    membrane, bending, gradient = energy(cloth, moved)
    assert membrane < 1e-20
    assert bending < 1e-20
    assert np.abs(gradient).max() < 1e-10
    bent = waved(mesh)
    first, second = energy(cloth, bent), energy(cloth, bent @ turn.T + [0.3, -0.2, 0.5])
    assert second[:2] == pytest.approx(first[:2], rel=1e-10)
    assert second[2] == pytest.approx(first[2] @ turn.T, abs=1e-9)


@pytest.mark.parametrize("name", MESHES)
def test_no_net_force_or_torque(name: str) -> None:
    at = folded(MESHES[name])
    gradient = energy(cloth_of(MESHES[name]), at)[2]
    scale = np.abs(gradient).sum()
    assert np.abs(gradient.sum(axis=0)).max() < 1e-12 * scale
    assert np.abs(np.cross(at, gradient).sum(axis=0)).max() < 1e-12 * scale


@pytest.mark.parametrize("name", MESHES)
def test_homogeneous_stretch(name: str) -> None:
    """The energy of a strain that is the same everywhere is exact on any mesh."""
    mesh = MESHES[name]
    x, y = mesh.rest.T
    area = 0.04 * 0.05
    Y, nu = 50.0, 0.3
    stretched = np.column_stack([1.02 * x + 0.01 * y, 0.99 * y, 0.0 * x])
    F = np.array([[1.02, 0.01], [0.0, 0.99]])
    G = 0.5 * (F.T @ F - np.eye(2))
    exact = 0.5 * Y / (1 - nu**2) * (G[0, 0] ** 2 + G[1, 1] ** 2 + 2 * nu * G[0, 0] * G[1, 1])
    exact += 0.5 * Y / (1 + nu) * 2 * G[0, 1] ** 2
    assert energy(cloth_of(mesh), stretched)[0] == pytest.approx(exact * area, rel=1e-12)


@pytest.mark.parametrize("poisson", [0.0, 0.3])
def test_pure_bending(poisson: float) -> None:
    """A narrow strip under end curvature: W per area is D (1 - nu^2) ... D, times kappa^2/2."""
    mesh = meshes.unstructured(0.02, 0.1, 0.004, 0)
    cloth = Cloth(mesh, isotropic(0.2, 50.0, 1e-5, poisson), preset_named("certified"))
    at = flat(mesh)
    at[:, 2] = 0.5 * mesh.rest[:, 1] ** 2
    bending = energy(cloth, at)[1] / (0.02 * 0.1 * 0.5 * 1e-5)
    assert (
        (1.0 - poisson**2) * 0.9 < bending < 1.0 + 1e-9
    )  # triangles at the ends are free to lie flat


@pytest.mark.parametrize("kind", [*DIAGONALS[:2], 0, 1])
def test_linear_plate(kind: MeshKind) -> None:
    """The tip of a horizontal cantilever, nu = 0, sags by rho g L^4 / 8D: to 0.08 %."""
    clamped = strip(0.02, 50, kind)
    density, rigidity, g = 0.2, 1e-5, 9.81
    cloth = Cloth(
        clamped.mesh,
        isotropic(density, 500.0, rigidity),
        preset_named("certified"),
        held=clamped.held,
    )
    at = flat(clamped.mesh)
    free = np.setdiff1d(np.arange(len(at)), clamped.held)
    K = np.empty((len(free), len(free)))
    for column, vertex in enumerate(free):
        moved = at.copy()
        moved[vertex, 2] = 1e-7
        K[:, column] = energy(cloth, moved)[2][free, 2] / 1e-7
    sag = np.zeros(len(at))
    sag[free] = np.linalg.solve(K, cloth.masses[free] * g)
    assert sag[clamped.tip].mean() == pytest.approx(
        density * g * LENGTH**4 / (8.0 * rigidity), rel=8e-4
    )


def test_moment_falls_behind_curvature_up_to_half_of_its_bound() -> None:
    """A strip on a cylinder: the energy per area is that of M = (D - |b| k) k, then of D k/2."""
    rigidity, softening = 1e-5, 100.0
    plain = isotropic(0.2, 50.0, rigidity)
    soft = replace(plain, softening=softening)
    mesh = meshes.grid(0.02, 0.04, 8, 64)
    for curvature in (5.0, 30.0, 50.0, 80.0):
        x, y = mesh.rest.T
        rolled = np.column_stack(
            [x, np.sin(curvature * y) / curvature, (1.0 - np.cos(curvature * y)) / curvature]
        )
        energies = [energy(cloth_of(mesh, of), rolled)[1] for of in (plain, soft)]
        corner = min(curvature, 0.5 * softening)
        expected = 0.5 * corner**2 - corner**3 / (3.0 * softening)
        expected += 0.25 * (curvature**2 - corner**2)
        assert energies[1] / energies[0] == pytest.approx(expected / (0.5 * curvature**2), rel=1e-3)


def test_soft_bending_is_convex_in_curvature_whatever_warp_and_weft_are() -> None:
    """No direction of bending of a bent sheet has a negative stiffness."""
    soft = replace(
        isotropic(0.2, 50.0, 1e-5),
        rigidity=np.diag([2e-5, 1e-6, 1e-6]),
        softening=100.0,
        name="unlike",
    )
    mesh = meshes.grid(0.02, 0.02, 6, 6)
    x, y = mesh.rest.T
    rng = np.random.default_rng(4)
    # Shallow shapes: their curvatures are linear in the heights.
    for height in (1e-4, 3e-4, 1e-3):
        bent = np.column_stack([x, y, height * (1e4 * x**2 + 3e3 * x * y)])
        sheet = mesh.rest, mesh.triangles, soft.density, 0.0 * soft.stretching + 1e-9, soft.rigidity
        for _ in range(20):
            w = np.zeros_like(bent)
            w[:, 2] = rng.normal(size=len(x))
            forces = np.asarray(_testing.stiffness_times(*sheet, bent, w, 100.0))
            assert float((forces * w).sum()) > 0.0
