"""The plate strip under its own weight: another discretisation, equilibrium, and finer meshes."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh

from stickslip_sim_core.reference import plate_buckling
from stickslip_sim_core.reference.plate_buckling import buckling_weight

pytestmark = pytest.mark.physics

Floats = NDArray[np.float64]


def ritz_weight(aspect: float, poisson: float, n: int) -> float:
    """Buckling weight with n x n Legendre polynomials over the whole strip, no symmetry used, as
    one eigenproblem.
    """
    x, wx = np.polynomial.legendre.leggauss(2 * n)
    x, wx = (x + 1) / 2, wx / 2
    eta, we = np.polynomial.legendre.leggauss(2 * n)
    P = [np.polynomial.Legendre.basis(k) for k in range(n)]

    def table(points: Floats, zeros: int, scale: float, start: float) -> list[Floats]:
        """Derivatives 0 ... 2 of (point - start)^zeros P_k over the coordinate scale * point."""
        line = np.polynomial.Polynomial([-start, 1])
        products = [(line**zeros) * p.convert(kind=np.polynomial.Polynomial) for p in P]
        return [
            np.stack([f.deriv(m)(points) if m else f(points) for f in products], axis=1) / scale**m
            for m in (0, 1, 2)
        ]

    # In x the polynomials are those of 2 x - 1.
    def along(zeros: int) -> list[Floats]:
        return table(2 * x - 1, zeros, 0.5, -1.0)

    across = table(eta, 0, aspect / 2, 0.0)
    weights = np.outer(wx, we * aspect / 2).ravel()

    def grid(X: list[Floats], i: int, j: int) -> Floats:
        return np.asarray(np.einsum("xi,yj->xyij", X[i], across[j]).reshape(len(weights), n * n))

    X = along(1)
    f, f_x, f_y = grid(X, 0, 0), grid(X, 1, 0), grid(X, 0, 1)
    G = (1 - poisson) / 2
    W = weights[:, None]
    uu, vv = f_x.T @ (W * f_x) + G * f_y.T @ (W * f_y), f_y.T @ (W * f_y) + G * f_x.T @ (W * f_x)
    uv = poisson * f_x.T @ (W * f_y) + G * f_y.T @ (W * f_x)
    coefficients = np.linalg.solve(
        np.block([[uu, uv], [uv.T, vv]]), np.concatenate([np.zeros(n * n), -f.T @ weights])
    )
    u, v = coefficients[: n * n], coefficients[n * n :]
    N = f_x @ u + poisson * f_y @ v, f_y @ v + poisson * f_x @ u, G * (f_y @ u + f_x @ v)

    X = along(2)
    xx, yy, xy, w_x, w_y = (grid(X, i, j) for i, j in ((2, 0), (0, 2), (1, 1), (1, 0), (0, 1)))
    trace = xx + yy
    K = trace.T @ (W * trace) - (1 - poisson) * (
        xx.T @ (W * yy) + yy.T @ (W * xx) - 2 * xy.T @ (W * xy)
    )
    cross = w_x.T @ (weights[:, None] * N[2][:, None] * w_y)
    S = w_x.T @ (W * N[0][:, None] * w_x) + w_y.T @ (W * N[1][:, None] * w_y) + cross + cross.T
    scale = 1 / np.sqrt(np.diag(K))
    load = eigh(-S * scale * scale[:, None], K * scale * scale[:, None], eigvals_only=True)
    return float(1 / load[-1])


@pytest.mark.parametrize(("aspect", "poisson"), [(0.3, 0.0), (0.3, 0.3), (1.0, 0.5)])
def test_another_discretisation(aspect: float, poisson: float) -> None:
    """Without a mesh that is graded towards the corners it stays 1e-3 off."""
    assert buckling_weight(aspect, poisson) == pytest.approx(
        ritz_weight(aspect, poisson, 11), rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [0.05, 1.0])
@pytest.mark.parametrize("poisson", [0.0, 0.5])
def test_converged(aspect: float, poisson: float) -> None:
    """Finer meshes of higher degree move the answer by less than 5e-5, coarser ones by more than
    finer.
    """
    coarse, default = (
        buckling_weight(aspect, poisson, degree=d, layers=k) for d, k in ((3, 3), (4, 4))
    )
    fine = buckling_weight(aspect, poisson, degree=5, layers=4)
    assert default == pytest.approx(fine, rel=5e-5)
    assert abs(default - fine) < 0.3 * abs(coarse - fine)
    assert coarse == pytest.approx(fine, rel=1e-3)


def test_forces_are_in_equilibrium() -> None:
    """Across every section act the weight beyond it and its moment.

    Far from the clamp sigma_xx is that of a beam.
    """
    aspect, degree = 0.2, 4
    x, y = plate_buckling._breaks_along(aspect, 4), plate_buckling._breaks_across(aspect, 4)
    N_xx, _, N_xy = plate_buckling._membrane_forces(x, y, 0.3, degree)
    along, across = (
        plate_buckling._functions(x, degree, 1, 1),
        plate_buckling._functions(y, degree, 1, 1),
    )
    X, Y = along.values[0][:, 0], across.values[0][:, 0]
    np.testing.assert_allclose(2 * N_xy @ across.weights, -aspect * (1 - X), atol=2e-3 * aspect)
    np.testing.assert_allclose(
        2 * N_xx @ (across.weights * Y), aspect * (1 - X) ** 2 / 2, atol=2e-3 * aspect
    )
    far = (X > 0.5) & (X < 0.6)
    # Plane stress of a beam under body force: 6 (1 - x)^2 y / w^2 and a correction that does not
    # depend on x.
    beam = 6 * (1 - X[:, None]) ** 2 * Y / aspect**2 + (Y / 5 * 3 - 4 * Y**3 / aspect**2)
    np.testing.assert_allclose(N_xx[far], beam[far], atol=2e-3 * np.abs(beam[far]).max())
