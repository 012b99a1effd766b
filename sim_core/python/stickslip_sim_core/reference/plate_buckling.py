"""Lateral buckling of a plate strip under its own weight, by Ritz's method.

The strip fills 0 <= x <= 1, |y| <= w / 2 (lengths in units of L). It is clamped along x = 0, and
its weight pulls it along -y, in its plane. Thickness h and Young's modulus Y enter only the
stiffnesses, and the answer does not depend on them. The method has two steps:

1. Plane stress. Displacements (u, v) with u = v = 0 at the clamp minimise 1/2 int N : eps - int
   (rho_A g) (-v), with N = Y h / (1 - nu^2) [(1 - nu) eps + nu tr(eps) I]. Every other edge is
   free. The membrane forces N are statically determined up to the clamp. In units of rho_A g L they
   depend on w and nu alone.
2. Kirchhoff's plate. The strip leaves its plane at the least Gamma = rho_A g L^3 / D, D = Y h^3 /
   (12 (1 - nu^2)), at which with W = dW/dx = 0 at the clamp the second variation

       int (lap W)^2 - 2 (1 - nu) (W_xx W_yy - W_xy^2) + Gamma int N_xx W_x^2 + 2 N_xy W_x W_y +
       N_yy W_y^2

   has a zero [Timoshenko and Gere 1961, Sec. 8.2]. The plate is thin, so nothing turns before it
   buckles.

Both fields are products of piecewise polynomials. Stresses are singular at the two corners of the
clamp, so the meshes are graded towards them. A basis whose highest derivative is orthonormal,
integrated from zero, keeps the matrices well conditioned for elements of any size.

A strip that is turned over is pulled the other way. Therefore u is odd in y and v is even, N_xx and
N_yy are odd and N_xy is even, and N couples only even W with odd W. With their stiffnesses A, B and
the coupling C, Gamma is one over the largest singular value of A^{-1/2} C B^{-1/2}. Half the strip,
y > 0, is enough.
"""

from dataclasses import dataclass
from math import factorial

import numpy as np

from stickslip_sim_core.arrays import Floats

# Degree of the highest derivatives, W_xx and u_x.
DEGREE = 4
# Number of elements between the clamp and x = w, and between an edge and y = 0.
LAYERS = 4

# Ratio of a layer's end to the end of the layer before. Beyond x = w elements double the distance
# from the clamp, up to the longest element.
GRADING = 4.0
LONGEST = 0.25


@dataclass(frozen=True, eq=False)
class _Axis:
    """Functions of one coordinate at the Gauss points of its elements."""

    weights: Floats
    """Weights of the Gauss points, shape (p,)."""

    values: tuple[Floats, ...]
    """Derivatives 0, 1 and, for the plate, 2 of the functions, shape (p, n) each."""

    @property
    def size(self) -> int:
        return int(self.values[0].shape[1])


def buckling_weight(
    aspect: float, poisson: float, *, degree: int = DEGREE, layers: int = LAYERS
) -> float:
    """Return Gamma = rho_A g L^3 / D at which a strip of width aspect * L buckles."""
    x = _breaks_along(aspect, layers)
    y = _breaks_across(aspect, layers)
    N_xx, N_yy, N_xy = _membrane_forces(x, y, poisson, degree)
    along, even, odd = (
        _functions(breaks, degree, 2, start) for breaks, start in ((x, None), (y, 0), (y, 1))
    )
    stiff_even, stiff_odd = (_bending_stiffness(along, across, poisson) for across in (even, odd))
    weights = np.outer(along.weights, even.weights)
    coupling = sum(
        _integral(along, (a, b), even, (c, d), odd, weights * N)
        for N, (a, b), (c, d) in (
            (N_xx, (1, 1), (0, 0)),
            (N_yy, (0, 0), (1, 1)),
            (N_xy, (1, 0), (0, 1)),
            (N_xy, (0, 1), (1, 0)),
        )
    )
    # Cholesky factors serve as the square roots of A and B: singular values are the same.
    scaled = np.linalg.solve(np.linalg.cholesky(stiff_even), coupling)
    scaled = np.linalg.solve(np.linalg.cholesky(stiff_odd), scaled.T)
    return float(1.0 / np.linalg.norm(scaled, 2))


def _breaks_along(aspect: float, layers: int) -> Floats:
    near = min(aspect, 1.0)
    breaks = [0.0, *(near * GRADING ** -np.arange(layers - 1.0, -1.0, -1.0))]
    while breaks[-1] < 1.0:
        left = 1.0 - breaks[-1]
        step = min(breaks[-1], LONGEST)
        # Stretch the last element rather than add a short one.
        breaks.append(1.0 if left < 1.5 * step else breaks[-1] + step)
    return np.array(breaks)


def _breaks_across(aspect: float, layers: int) -> Floats:
    return aspect / 2.0 * (1.0 - np.append(GRADING ** -np.arange(0.0, layers), 0.0))


def _functions(breaks: Floats, degree: int, order: int, start: int | None) -> _Axis:
    """Return functions whose derivative is an orthonormal Legendre polynomial on an element.

    `order` is the number of this derivative. The functions and their lower derivatives are zero at
    the first breakpoint. `start` adds the power of the coordinate that makes them complete among
    even (0) or odd (1) functions.
    """
    # The number of points of a rule that is exact for three factors.
    count = (3 * (degree + 2) + 1) // 2
    nodes, weights = np.polynomial.legendre.leggauss(count)
    half = np.diff(breaks) / 2.0
    # From the left end of an element of length 2: Legendre's polynomials and their repeated
    # integrals.
    local = [np.eye(degree + 1)]
    for _ in range(order):
        local.append(np.stack([np.polynomial.legendre.legint(c, lbnd=-1.0) for c in local[-1]]))
    elements = len(half)
    n = degree + 1
    values = [np.zeros((elements * count, elements * n)) for _ in range(order + 1)]
    for e in range(elements):
        norm = np.sqrt((np.arange(n) + 0.5) / half[e])
        columns = slice(e * n, (e + 1) * n)
        at_end = np.zeros((order + 1, n))
        # k integrals give the derivative `order - k`.
        for k in range(order + 1):
            scale = norm * half[e] ** k
            rows = slice(e * count, (e + 1) * count)
            values[order - k][rows, columns] = (
                np.polynomial.legendre.legval(nodes, local[k].T).T * scale
            )
            at_end[k] = np.polynomial.legendre.legval(1.0, local[k].T) * scale
        # Beyond its element the highest derivative is zero. Taylor's polynomial at the end of the
        # element gives the lower derivatives.
        at_end[0] = 0.0
        beyond = (breaks[e + 1 : -1, None] + half[e + 1 :, None] * (nodes + 1.0)).ravel() - breaks[
            e + 1
        ]
        for k in range(1, order + 1):
            taylor = sum(np.outer(beyond**j / factorial(j), at_end[k - j]) for j in range(k))
            values[order - k][(e + 1) * count :, columns] = taylor
    if start is not None:
        points = (breaks[:-1, None] + half[:, None] * (nodes + 1.0)).ravel()
        powers = [points**start, np.full_like(points, float(start)), np.zeros_like(points)]
        values = [np.column_stack([powers[k], values[k]]) for k in range(order + 1)]
    return _Axis(np.outer(half, weights).ravel(), tuple(values))


def _integral(
    along: _Axis,
    orders_along: tuple[int, int],
    left: _Axis,
    orders_across: tuple[int, int],
    right: _Axis,
    weight: Floats,
) -> Floats:
    """Integrate weight(x, y) times derivatives of the products of two sets of functions."""
    (a, b) = orders_along
    (c, d) = orders_across
    pairs = np.einsum("yk,yl->ykl", left.values[c], right.values[d])
    weighted = np.tensordot(weight, pairs, axes=1)
    full = np.einsum("xi,xj,xkl->ikjl", along.values[a], along.values[b], weighted, optimize=True)
    return np.asarray(full.reshape(along.size * left.size, along.size * right.size))


def _product(
    along: _Axis,
    orders_along: tuple[int, int],
    left: _Axis,
    orders_across: tuple[int, int],
    right: _Axis,
) -> Floats:
    """Integrate derivatives of the products of two sets of functions, with a weight of one."""
    # Without a weight the integral is the product of two integrals of one coordinate each.
    (a, b) = orders_along
    (c, d) = orders_across
    first = along.values[a].T @ (along.weights[:, None] * along.values[b])
    second = left.values[c].T @ (left.weights[:, None] * right.values[d])
    return np.asarray(np.kron(first, second))


def _membrane_forces(
    x: Floats, y: Floats, poisson: float, degree: int
) -> tuple[Floats, Floats, Floats]:
    """Return N_xx, N_yy, N_xy over rho_A g L at the Gauss points, shape (points in x, points in y).

    The computation has units in which Y h / (1 - nu^2) = 1.
    """
    shear = (1.0 - poisson) / 2.0
    along, even, odd = (
        _functions(breaks, degree, 1, start) for breaks, start in ((x, None), (y, 0), (y, None))
    )
    uu = _product(along, (1, 1), odd, (0, 0), odd) + shear * _product(
        along, (0, 0), odd, (1, 1), odd
    )
    vv = _product(along, (0, 0), even, (1, 1), even) + shear * _product(
        along, (1, 1), even, (0, 0), even
    )
    uv = poisson * _product(along, (1, 0), odd, (0, 1), even) + shear * _product(
        along, (0, 1), odd, (1, 0), even
    )
    weight = -np.kron(along.weights @ along.values[0], even.weights @ even.values[0])
    stiffness = np.block([[uu, uv], [uv.T, vv]])
    coefficients = np.linalg.solve(stiffness, np.concatenate([np.zeros(len(uu)), weight]))
    u = coefficients[: len(uu)].reshape(along.size, -1)
    v = coefficients[len(uu) :].reshape(along.size, -1)

    def at(field: Floats, across: _Axis, i: int, j: int) -> Floats:
        return np.asarray(along.values[i] @ field @ across.values[j].T)

    u_x = at(u, odd, 1, 0)
    v_y = at(v, even, 0, 1)
    return u_x + poisson * v_y, v_y + poisson * u_x, shear * (at(u, odd, 0, 1) + at(v, even, 1, 0))


def _bending_stiffness(along: _Axis, across: _Axis, poisson: float) -> Floats:
    """Return the matrix of int W_xx^2 + W_yy^2 + 2 nu W_xx W_yy + 2 (1 - nu) W_xy^2."""
    cross = _product(along, (2, 0), across, (0, 2), across)
    return (
        _product(along, (2, 2), across, (0, 0), across)
        + _product(along, (0, 0), across, (2, 2), across)
        + poisson * (cross + cross.T)
        + 2.0 * (1.0 - poisson) * _product(along, (1, 1), across, (1, 1), across)
    )
