"""Bending lengths of photographed yarn over the edge of a table, by the fits of this project.

python benchmarks/yarn.py CENTRELINES.csv [--thickness MM]

The file has the columns photo, length_mm, s_mm, x_mm and z_mm: points along each yarn, x away from
the table and z up. One yarn has one bending length, however long it hangs: L / gamma^(1/3) must be
the same for all lengths. Singal et al. 2024 (Nature Communications 15, 2622) publish such
photographs. Each is measured as `stickslip rods measure` does, with the tilt of the clamp fitted
and a roll of the camera that nobody measured. The last line says how many centrelines are refused
with a clamp along gravity.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core import fit_parameters
from stickslip_sim_core.photographs.bending import (
    UNKNOWN_ROLL,
    Bending,
    joint_bending,
    measure_centerline,
)


def centerlines(path: Path) -> dict[str, tuple[float, NDArray[np.float64]]]:
    """Return the length [mm] and the centreline (P, 2) [mm] of each photograph."""
    points = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    rods = {}
    for photo in dict.fromkeys(points["photo"]):
        rod = points[points["photo"] == photo]
        length = float(rod["s_mm"][-1])
        rods[str(photo)] = (length, np.stack([rod["x_mm"], rod["z_mm"]], axis=1))
    return rods


def is_refused(length: float, points: NDArray[np.float64]) -> bool:
    """Return whether the fit refuses a centreline with the clamp of a hanging rod."""
    x, z = points.T / length
    try:
        fit_parameters(np.stack([x, 0.0 * x, z], axis=1))
    except ValueError:
        return True
    return False


def print_photograph(photo: str, bending: Bending) -> None:
    """Print the result of a photograph, and the parts of its error."""
    tilt = np.degrees(bending.clamp_angle)
    print(
        f"{photo:6} bending length {bending.bending_length:4.1f} +- "
        f"{bending.bending_length_error:4.1f} mm (ledge {bending.change_at_ledge:+5.1f}, roll "
        f"{bending.change_by_roll:+5.1f}), natural bend {bending.natural_bend:5.1f} +- "
        f"{bending.natural_bend_error:4.1f} /m, tilt {tilt:5.1f} degrees, residual "
        f"{1e3 * bending.residual / bending.length:4.2f}e-3 L"
        f"{', bend for weight' * bending.trades_bend_for_weight}",
        flush=True,
    )


def print_lengths(measured: dict[float, list[Bending]]) -> None:
    """Print the bending length of each length, and of all photographs together."""
    for length, bendings in measured.items():
        joint = joint_bending(bendings)
        mean = np.mean([bending.bending_length for bending in bendings])
        print(
            f"{length:4.0f} mm long: mean {mean:.1f} mm, weighted {joint.bending_length:.1f} +- "
            f"{joint.error:.1f} mm, scatter {joint.scatter:.1f} mm"
        )
    joint = joint_bending([bending for bendings in measured.values() for bending in bendings])
    print(f"all: bending length {joint.bending_length:.1f} +- {joint.error:.1f} mm")


def main() -> None:
    """Print the fit of each photograph, and the mean of each length."""
    parser = argparse.ArgumentParser(description="Bending lengths of photographed yarn.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--thickness", type=float, default=2.0, help="of the yarn [mm]")
    options = parser.parse_args()
    rods = centerlines(options.file)
    measured: dict[float, list[Bending]] = {}
    for photo, (length, points) in rods.items():
        bending = measure_centerline(points, options.thickness, roll_error=UNKNOWN_ROLL)
        measured.setdefault(round(length, -1), []).append(bending)
        print_photograph(photo, bending)
    print_lengths(measured)
    refused = sum(is_refused(length, points) for length, points in rods.values())
    print(f"{refused} of {len(rods)} are refused with a clamp along gravity")


if __name__ == "__main__":
    main()
