"""Master curves of a strip that is clamped edge-on and buckles sideways under its own weight."""

from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import jv

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference import plate_buckling
from stickslip_sim_core.reference.boundary_values import within


def lateral_buckling_rod() -> float:
    """Return the weight rho A g L^3 / sqrt(EI GJ) at which a strip buckles sideways.

    The strip is clamped edge-on, in the limit w/L -> 0. It cannot bend in its plane, so it stays
    straight until it buckles. With x from the free end, the bending stiffness EI across the plane,
    the twisting stiffness GJ and the sideways slope eta,

        eta'' + (weight / 2)^2 x^4 eta = 0,   eta'(0) = 0,   eta(1) = 0,
        eta = sqrt(x) J_{-1/6}(weight x^3 / 6)

    [Prandtl 1899]. The weight is six times the first zero of the Bessel function J_{-1/6}.
    """
    return 6.0 * float(brentq(partial(jv, -1.0 / 6.0), 1.5, 2.5, xtol=1e-15))


def lateral_buckling(aspect: ArrayLike, poisson: float) -> Floats:
    """Return the weight Gamma* = rho_A g L^3 / D at which a plate strip buckles, to 5e-5.

    The strip has length L and width aspect * L, and buckles sideways. One of its short edges is
    clamped in displacement and slope, with the width vertical. Its other edges are free. Its mass
    per area is rho_A, and its bending rigidity is D = Y h^3 / (12 (1 - poisson^2)). In units of
    rho_A g L^3 / (Y h^3 / 12) the answer is Gamma* / (1 - poisson^2).

    The model is plane stress under the weight and Kirchhoff's plate, both linear until the strip
    buckles. It holds for a strip that is much thinner than wide. plate_buckling.py solves it. As
    aspect goes to zero,

        Gamma* = lateral_buckling_rod() sqrt(2 / (1 + poisson)) (1 - poisson^2) (1 + O(aspect)).

    Args:
        aspect: Width over length [-], in [0.01, 1], any shape.
        poisson: Poisson's ratio [-], in [0, 0.5].

    Raises:
        ValueError: An argument breaks its rule.
    """
    values = within("aspect", aspect, 0.01, 1.0)
    nu = float(within("poisson", poisson, 0.0, 0.5))
    return np.array([plate_buckling.buckling_weight(float(v), nu) for v in values.ravel()]).reshape(
        values.shape
    )
