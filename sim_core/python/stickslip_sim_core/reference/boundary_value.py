"""Two-point boundary value problems with unknown parameters, by Gauss collocation: what the master curves stand on.

    y'(x) = f(x, y, p) on the mesh x_0 < ... < x_E,    b(y(x_0), y(x_E), p) = 0,    n + q conditions for n fields and q
    parameters p.

Every element is one step of the Gauss method with `STAGES` stages [Hairer, Norsett and Wanner 1993, Sec. II.7]: order
2 STAGES at the mesh points, symmetric, and stable where solutions decay or grow fast. All steps are solved together by
Newton's method, so that unlike shooting nothing is integrated over many growth lengths.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats

Numbers = NDArray[np.inexact]
Rate = Callable[[Floats, Numbers, Numbers], Numbers]
Conditions = Callable[[Numbers, Numbers, Numbers], Numbers]

STAGES = 8

# Newton's method: the largest relative update that counts as solved, and iterations before it gives up.
TOLERANCE = 1e-11
ITERATIONS = 60

# Imaginary step of the complex-step derivative: it has no truncation error left and no cancellation.
COMPLEX_STEP = 1e-30


class NotSolvedError(RuntimeError):
    """Newton's method found no solution from this guess."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Fields at the mesh points and between them, with the parameters."""

    mesh: Floats
    """Mesh points x, shape (E + 1,)."""

    y: Floats
    """Fields at the mesh points, shape (n, E + 1)."""

    stages: Floats
    """Fields at the Gauss points of the elements, shape (n, E, STAGES)."""

    parameters: Floats
    """Parameters p, shape (q,)."""

    def integral(self, integrand: Callable[[Floats], Floats]) -> float:
        """Integrate a function of the fields over x by the Gauss rule of the elements."""
        _, b, _ = gauss_method()
        return float(np.sum(integrand(self.stages) * b * np.diff(self.mesh)[:, None]))


@cache
def gauss_method() -> tuple[Floats, Floats, Floats]:
    """Matrix A, weights b and nodes c of the Gauss method on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(STAGES)
    c = (x + 1.0) / 2.0
    # Row i of A integrates Lagrange's polynomials from 0 to c_i. In Legendre's basis the interpolation is exact, by the
    # Gauss rule: coefficient k is (2 k + 1) / 2 sum_j w_j P_k(x_j), and int P_k = (P_{k+1} - P_{k-1}) / (2 k + 1).
    P = np.polynomial.legendre.legvander(x, STAGES)
    integrals = np.empty((STAGES, STAGES))  # of P_k from -1 to x_i
    integrals[:, 0] = x + 1.0
    for k in range(1, STAGES):
        integrals[:, k] = (P[:, k + 1] - P[:, k - 1]) / (2 * k + 1)
    coefficients = (np.arange(STAGES)[:, None] + 0.5) * P[:, :STAGES].T * w
    return integrals @ coefficients / 2.0, w / 2.0, c


def solve(rate: Rate, conditions: Conditions, mesh: Floats, y: Floats, parameters: Floats | None = None) -> Solution:
    """Solve the problem by Newton's method from a guess at the mesh points.

    Args:
        rate: f(x, y, p) for x of shape (...), y of shape (n, ...) and p of shape (q,); analytic, complex numbers too.
        conditions: b(y(x_0), y(x_E), p), shape (n + q,); analytic, too.
        mesh: Mesh points, increasing, shape (E + 1,).
        y: Guess, shape (n, E + 1).
        parameters: Guess of the unknown parameters, shape (q,); none by default.

    Raises:
        NotSolvedError: Newton's method did not converge.
    """
    p = np.zeros(0) if parameters is None else np.array(parameters, dtype=float)
    n, elements, q = len(y), len(mesh) - 1, len(p)
    A, b, c = gauss_method()
    h = np.diff(mesh)
    x = mesh[:-1, None] + h[:, None] * c
    y = np.array(y, dtype=float)
    slope = np.repeat(np.diff(y, axis=1)[:, :, None] / h[:, None], STAGES, axis=2)

    def at_stages(y: Floats, slope: Floats) -> Floats:
        return np.asarray(y[:, :-1, None] + h[:, None] * (slope @ A.T))

    def residuals(y: Floats, slope: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        stage = rate(x, at_stages(y, slope), p) - slope
        step = y[:, :-1] + h * (slope @ b) - y[:, 1:]
        return np.asarray(stage), step, np.asarray(conditions(y[:, 0], y[:, -1], p))

    for _ in range(ITERATIONS):
        stage, step, ends = residuals(y, slope, p)
        size = max(np.abs(part).max() for part in (stage, step, ends))
        scale = max(np.abs(y).max(), np.abs(slope).max(), 1.0)
        # Stages: (I - h J A) dslope = J dy + F dp + stage. Solved per element for all right-hand sides at once.
        # J = df/dy is (n, E, n, STAGES), F = df/dp (n, E, q, STAGES).
        J, F = np.split(np.stack(_derivatives(partial(rate, x), at_stages(y, slope), p), axis=2), [n], axis=2)
        matrix = np.einsum("e,iejs,st->esitj", -h, J, A).reshape(elements, STAGES * n, STAGES * n)
        matrix += np.eye(STAGES * n)
        right = np.concatenate([J, F, stage[:, :, None, :]], axis=2).transpose(1, 3, 0, 2)
        dslope = np.linalg.solve(matrix, right.reshape(elements, STAGES * n, n + q + 1))
        moved = h[:, None, None] * np.einsum("s,esik->eik", b, dslope.reshape(elements, STAGES, n, n + q + 1))
        # Steps and conditions: one linear system for the fields at the mesh points and the parameters.
        total = n * (elements + 1) + q
        system, rhs = np.zeros((total, total)), np.zeros(total)
        for e in range(elements):
            rows, here, there = (slice(n * k, n * (k + 1)) for k in (e, e, e + 1))
            system[rows, here] = np.eye(n) + moved[e, :, :n]
            system[rows, there] = -np.eye(n)
            system[rows, total - q :] = moved[e, :, n : n + q]
            rhs[rows] = -step[:, e] - moved[e, :, -1]
        first_last_parameters = np.r_[:n, n * elements : total]
        system[n * elements :, first_last_parameters] = np.stack(_derivatives(conditions, y[:, 0], y[:, -1], p), axis=1)
        rhs[n * elements :] = -ends
        try:
            update = np.linalg.solve(system, rhs)
        except np.linalg.LinAlgError as error:
            raise NotSolvedError("the linearised problem is singular") from error
        dy, dp = update[: total - q].reshape(elements + 1, n).T, update[total - q :]
        unknowns = np.concatenate([dy[:, :-1], np.tile(dp[:, None], elements), np.ones((1, elements))])
        ds = np.einsum("eak,ke->ea", dslope, unknowns).reshape(elements, STAGES, n).transpose(2, 0, 1)

        length = 1.0
        while length > 1e-3:
            trial = residuals(y + length * dy, slope + length * ds, p + length * dp)
            if max(np.abs(part).max() for part in trial) < (1.0 - 0.1 * length) * size or size < 1e-9 * scale:
                break
            length *= 0.5
        y, slope, p = y + length * dy, slope + length * ds, p + length * dp
        if not np.isfinite(y).all() or not np.isfinite(slope).all():
            break
        change = max(
            np.abs(dy).max() / max(np.abs(y).max(), 1.0), np.abs(dp / np.maximum(np.abs(p), 1.0)).max(initial=0.0)
        )
        if length == 1.0 and change < TOLERANCE:
            return Solution(mesh, y, at_stages(y, slope), p)
    raise NotSolvedError(f"no convergence in {ITERATIONS} iterations")


def _derivatives(f: Callable[..., Numbers], *parts: Floats) -> list[Floats]:
    """Derivatives of f(*parts) by each row of each part."""
    columns = []
    for part, rows in enumerate(parts):
        for row in range(len(rows)):
            moved = [np.array(other, dtype=complex) for other in parts]
            moved[part][row] += 1j * COMPLEX_STEP
            columns.append(np.imag(f(*moved)) / COMPLEX_STEP)
    return columns
