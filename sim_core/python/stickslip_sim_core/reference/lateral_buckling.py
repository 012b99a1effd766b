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

    The strip is clamped edge-on, in the limit w/L -> 0.

    A strip that cannot bend in its own plane stays straight until then. With x from the free end,
    EI its bending stiffness across the plane, GJ its twisting stiffness and eta the sideways slope,

        eta'' + (weight / 2)^2 x^4 eta = 0,   eta'(0) = 0,   eta(1) = 0,
        eta = sqrt(x) J_{-1/6}(weight x^3 / 6)

    [Prandtl 1899]: six times the first zero of the Bessel function J_{-1/6}.
    """
    return 6.0 * float(brentq(partial(jv, -1.0 / 6.0), 1.5, 2.5, xtol=1e-15))


def lateral_buckling(aspect: ArrayLike, poisson: float) -> Floats:
    """Return the weight Gamma* = rho_A g L^3 / D at which a plate strip buckles, to 5e-5.

    The strip is clamped edge-on and buckles sideways.

    The strip of length L and width aspect * L is clamped along one short edge, with its width
    vertical, in displacement and slope; its other edges are free. rho_A is its mass per area, D = Y
    h^3 / (12 (1 - poisson^2)) its bending rigidity, so that per unit of rho_A g L^3 / (Y h^3 / 12)
    the answer is Gamma* / (1 - poisson^2). Plane stress under its weight and Kirchhoff's plate,
    both linear until it buckles: a strip much thinner than wide. How they are solved:
    plate_buckling.py. As aspect goes to zero,

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
