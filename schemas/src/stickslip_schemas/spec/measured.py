"""Statistics of 618 measured fabrics [Feng et al. 2022], from which fabrics are drawn."""

import math
from collections.abc import Sequence
from functools import cache

MEASURED_MEAN = (-0.777, -4.901, -5.077, -4.998)
MEASURED_DEVIATION = (0.350, 0.611, 0.543, 0.561)
MEASURED_CORRELATION = (
    (1.0, 0.717, 0.717, 0.758),
    (0.717, 1.0, 0.855, 0.900),
    (0.717, 0.855, 1.0, 0.868),
    (0.758, 0.900, 0.868, 1.0),
)
"""Statistics of 618 fabrics [Feng et al. 2022]: of log10 of the mass per area [kg/m^2], and of the
rigidities along the warp, along the weft and at 45 degrees [N m]."""

SOFTENING_QUANTILES = (
    (0.05, 162.0),
    (0.25, 275.0),
    (0.50, 372.0),
    (0.75, 540.0),
    (0.95, 1088.0),
)
"""Quantiles of D0/|b| of the same fabrics [1/m], over warp and weft."""


def measured_draw(normals: Sequence[float]) -> tuple[float, float, float, float]:
    """Return density, warp, weft and diagonal of one draw of the 618 fabrics [SI].

    x = mean + sd L n, with the Cholesky factor L of the correlations and normal numbers n.
    """
    factor = _cholesky()
    drawn = []
    for mean, deviation, row in zip(MEASURED_MEAN, MEASURED_DEVIATION, factor, strict=True):
        correlated = sum(weight * normal for weight, normal in zip(row, normals, strict=True))
        drawn.append(10.0 ** (mean + deviation * correlated))
    density, warp, weft, diagonal = drawn
    return density, warp, weft, diagonal


def measured_softening(share: float) -> float:
    """Return the quantile of D0/|b| of the 618 fabrics [1/m]; its logarithm is linear between.

    The lowest and the highest known quantile stand for all beyond them.
    """
    (below, low), *_ = SOFTENING_QUANTILES
    for at, value in SOFTENING_QUANTILES:
        if share <= at:
            part = 1.0 if at == below else (share - below) / (at - below)
            return low * math.exp(max(part, 0.0) * math.log(value / low))
        below, low = at, value
    return low


@cache
def _cholesky() -> tuple[tuple[float, ...], ...]:
    """Return the lower Cholesky factor of the correlations: (4, 4)."""
    size = len(MEASURED_CORRELATION)
    factor = [[0.0] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            rest = MEASURED_CORRELATION[i][j] - sum(factor[i][k] * factor[j][k] for k in range(j))
            factor[i][j] = math.sqrt(rest) if i == j else rest / factor[j][j]
    return tuple(tuple(row) for row in factor)
