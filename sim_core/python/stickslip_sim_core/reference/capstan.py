"""Master curve of a strip that slides over a cylinder."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference.boundary_values import positive, within


def capstan(mu: ArrayLike, wrap: float, bending: float = 0.0) -> Floats:
    """Return T2/T1, the ratio of the heavy pull to the light pull on a strip over a cylinder.

    The strip slides. It has no weight and the bending stiffness D, and the cylinder has the radius
    R. Let B = D / (2 R^2). Each free end meets the cylinder at an angle phi_i, for which
    1 - cos(phi_i) = B / T_i. There it presses on the cylinder with sqrt(2 T_i B - B^2), and this
    force rubs, too:

        N1 = T1 - B + mu sqrt(2 T1 B - B^2),
        T2 - B - mu sqrt(2 T2 B - B^2) = N1 exp(mu (wrap - phi_1 - phi_2)).

    Without bending the ratio is Euler's exp(mu wrap) [Euler 1769; Stuart 1961].

    Args:
        mu: Coefficient of friction, >= 0, any shape.
        wrap: Angle between the far directions of both ends [rad], > 0.
        bending: B / T1, in [0, 1).

    Raises:
        ValueError: An argument breaks its rule, or the strip does not lie on the cylinder.
    """
    values = within("mu", mu, 0.0, np.inf)
    positive("wrap", wrap)
    within("bending", bending, 0.0, 1.0 - 1e-12)
    return np.array(
        [_capstan(float(m), float(wrap), float(bending)) for m in values.ravel()]
    ).reshape(values.shape)


def _capstan(mu: float, wrap: float, bending: float) -> float:
    # A stiff strip needs some angle at either end to bend onto the cylinder.
    first = np.arccos(1.0 - bending)
    if not wrap > 2.0 * first:
        raise ValueError(
            f"wrap: must be above {2.0 * first:.4g} rad at bending = {bending}, got {wrap}"
        )
    light = 1.0 - bending + mu * np.sqrt(2.0 * bending - bending**2)

    def missed(heavy: float) -> float:
        tail = mu * np.sqrt(2.0 * heavy * bending - bending**2)
        lying = wrap - first - np.arccos(1.0 - bending / heavy)
        return float((heavy - bending - tail) / (light * np.exp(mu * lying)) - 1.0)

    # The heavy pull is at least the light pull, 1, and has no upper bound. Double the bracket until
    # it contains the heavy pull.
    high = 2.0
    while missed(high) < 0.0:
        high *= 2.0
    return float(brentq(missed, 1.0, high, xtol=1e-14))
