"""Bending lengths of photographed yarn over the edge of a table, by the fits of this project.

python benchmarks/yarn.py CENTRELINES.csv [--tilt]

The file has the columns photo, length_mm, s_mm, x_mm and z_mm: points along each yarn, x away from
the table and z up. One yarn has one bending length, however long it hangs: L / gamma^(1/3) must be
the same for all lengths. Singal et al. 2024 (Nature Communications 15, 2622) publish such
photographs. With --tilt, the tilt of the clamp is fitted, too. The last lines say whether each
centreline is refused with a clamp along gravity.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core import ParameterFit, fit_parameters, fit_tilted_clamp

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Columns d1 = x (away from the table), d2 = z (up), d3 = -y (across the photograph)."""


def centerlines(path: Path) -> dict[str, tuple[float, NDArray[np.float64]]]:
    """Return the length [mm] and the centreline (P, 3) [L] of each photograph."""
    points = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    rods = {}
    for photo in dict.fromkeys(points["photo"]):
        rod = points[points["photo"] == photo]
        length = float(rod["s_mm"][-1])
        plane = np.stack([rod["x_mm"], np.zeros(len(rod)), rod["z_mm"]], axis=1)
        rods[str(photo)] = (length, plane / length)
    return rods


def is_refused(centerline: NDArray[np.float64]) -> bool:
    """Return whether the fit refuses a centreline with the clamp of a hanging rod."""
    try:
        fit_parameters(centerline)
    except ValueError:
        return True
    return False


def fitted(centerline: NDArray[np.float64], *, with_tilt: bool) -> tuple[ParameterFit, str]:
    """Return the fit of a centreline, and the fitted tilt of its clamp in words."""
    if not with_tilt:
        return fit_parameters(centerline, phi0=0.0, clamp_frame=LEVEL), ""
    fit = fit_tilted_clamp(centerline, phi0=0.0, clamp_frame=LEVEL)
    tilt, error = np.degrees([fit.tilt, fit.tilt_error])
    return fit.rod, f", tilt {tilt:5.1f} +- {error:.1f} degrees"


def main() -> None:
    """Print the fit of each photograph, and the mean of each length."""
    parser = argparse.ArgumentParser(description="Bending lengths of photographed yarn.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--tilt", action="store_true", help="fit the tilt of the clamp, too")
    options = parser.parse_args()
    rods = centerlines(options.file)
    bending_lengths: dict[float, list[float]] = {}
    for photo, (length, centerline) in rods.items():
        # A photograph does not show twist.
        fit, tilt = fitted(centerline, with_tilt=options.tilt)
        bending_length = length / fit.gamma ** (1 / 3)
        bending_lengths.setdefault(round(length, -1), []).append(bending_length)
        print(
            f"{photo:6} gamma {fit.gamma:6.0f} +- {fit.standard_error[0]:4.0f}, natural bend "
            f"{fit.phi1:5.2f} /L, residual {1e3 * fit.residual:5.2f}e-3 L, bending length "
            f"{bending_length:4.1f} mm{tilt}{', bend for weight' * fit.trades_bend_for_weight}"
        )
    for length, values in bending_lengths.items():
        mean = np.mean(values)
        print(f"{length:4.0f} mm long: bending length {mean:.1f} +- {np.std(values):.1f} mm")
    refused = sum(is_refused(centerline) for _, centerline in rods.values())
    print(f"{refused} of {len(rods)} are refused with a clamp along gravity")


if __name__ == "__main__":
    main()
