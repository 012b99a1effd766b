"""The thesis's 160 drags with the checks of today: how many runs are not valid, and why.

    python benchmarks/false_alarms.py [--mesh 21] [--preset certified] [--processes 2]

Ten fabrics are dragged with sixteen coefficients of friction each. They touch themselves. Each such
drag can be simulated, so a run that is not valid is a false alarm, unless its reason is true.
Prints a line for each of them, the most that a check reached of its limit, and a sum.
"""

import argparse
import json
import multiprocessing
import time
from typing import Any, NamedTuple

import numpy as np
from stickslip_sim_core.cloth.checks import CHECKS
from stickslip_sim_core.cloth.fabrics import fabric_names
from stickslip_sim_core.scenes import cloth_drag

FRICTIONS = np.linspace(0.1, 1.6, 16).round(2)
SELF_FRICTION = 0.5


class GridPoint(NamedTuple):
    """The parameters of a drag of the grid."""

    material: str
    mu: float
    mesh: int
    preset: str


def report(point: GridPoint) -> dict[str, Any]:
    """Run a drag, and return its verdict and the largest share of a limit."""
    begin = time.process_time()
    run = cloth_drag.scene(
        point.material,
        point.mu,
        mesh=point.mesh,
        preset=point.preset,
        self_friction=SELF_FRICTION,
        seed=round(1000 * point.mu),
    ).run()
    shares = {check.name: run.labels[check.name] / check.limit for check in CHECKS if check.limit}
    nearest = max(shares, key=lambda name: shares[name])
    return {
        "material": point.material,
        "mu": point.mu,
        "valid": run.valid,
        "reason": run.reason,
        "nearest": nearest,
        "share_of_limit": round(shares[nearest], 3),
        "unconverged_steps": run.labels["unconverged_steps"],
        "steps": run.labels["steps"],
        "cpu_seconds": time.process_time() - begin,
    }


def main() -> None:
    """Run the grid."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mesh", type=int, default=21)
    parser.add_argument("--preset", default="certified")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    points = [
        GridPoint(material, float(mu), options.mesh, options.preset)
        for material in fabric_names()
        for mu in FRICTIONS
    ]
    with multiprocessing.Pool(options.processes) as pool:
        reports = pool.map(report, points, chunksize=1)
    for each in reports:
        if not each["valid"]:
            print(json.dumps(each))
    nearest = max((r for r in reports if r["valid"]), key=lambda r: float(r["share_of_limit"]))
    print("nearest to a limit:", json.dumps(nearest))
    seconds = [r["cpu_seconds"] for r in reports]
    print(
        f"{sum(r['valid'] for r in reports)} of {len(reports)} valid, "
        f"{sum(r['unconverged_steps'] for r in reports)} of {sum(r['steps'] for r in reports)} "
        f"steps unconverged; {np.median(seconds):.1f} CPU s median, {max(seconds):.1f} at most"
    )


if __name__ == "__main__":
    main()
