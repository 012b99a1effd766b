"""How well the master curves are converged, and what they cost.

python benchmarks/master_curves.py

Errors are against finer discretisations of the same curve; that they are the right curves is for
the tests, which compare with other methods and limits. CPU seconds are those of the process, one
thread.
"""

import os
import time
from collections.abc import Callable

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core.reference import boundary_values, master_curves, plate_buckling

Floats = NDArray[np.float64]


def with_tolerance(tolerance: float, curve: Callable[[], Floats]) -> Floats:
    usual, boundary_values.TOLERANCE = boundary_values.TOLERANCE, tolerance
    try:
        return curve()
    finally:
        boundary_values.TOLERANCE = usual


def collocated(name: str, x: Floats, curve: Callable[[Floats], Floats]) -> None:
    start = time.process_time()
    values = curve(x)
    spent = time.process_time() - start
    coarse, fine = (with_tolerance(tolerance, lambda: curve(x)) for tolerance in (1e-8, 1e-10))
    errors = [np.abs(other / fine - 1.0).max() for other in (coarse, values)]
    print(
        f"{name:18} {x[0]:8.2g} ... {x[-1]:8.6g}  tolerance 1e-8 {errors[0]:.0e}  1e-9 (used) "
        f"{errors[1]:.0e}",
        end="",
    )
    print(f"  {1e3 * spent / len(x):.1f} ms a point")


def main() -> None:
    strain, friction = master_curves.stick_slip_triple_point()
    print(f"stick-slip: triple point at strain {strain:.12f}, mu {friction:.12f}")
    small = float(master_curves.stick_slip(1e-12)) / 1e-6
    print(f"stick-slip: mu / sqrt(strain) tends to {small:.9f}\n")
    collocated(
        "stick-slip", np.append(np.geomspace(1e-6, 0.33, 30), strain), master_curves.stick_slip
    )
    collocated("cantilever", np.geomspace(1e-3, 1e5, 33), master_curves.cantilever)

    print("\nlateral buckling of a plate strip: Gamma* over that of a rod; error against degree 5")
    for poisson in (0.0, 0.25, 0.5):
        rod = (
            master_curves.lateral_buckling_rod()
            * np.sqrt(2.0 / (1.0 + poisson))
            * (1.0 - poisson**2)
        )
        for aspect in (0.01, 0.05, 0.2, 0.5, 1.0):
            start = time.process_time()
            used = float(master_curves.lateral_buckling(aspect, poisson))
            spent = time.process_time() - start
            coarse, fine = (
                plate_buckling.buckling_weight(aspect, poisson, degree=d, layers=k)
                for d, k in ((3, 3), (5, 4))
            )
            print(
                f"  nu {poisson:4}  w/L {aspect:4}  Gamma* {used:10.6f}  over rod {used / rod:.5f}",
                end="",
            )
            print(
                f"  degree 3 {coarse / fine - 1:7.0e}  4 (used) {used / fine - 1:7.0e}  "
                f"{spent:.2f} s"
            )


if __name__ == "__main__":
    main()
