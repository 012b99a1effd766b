"""The thesis's cloth simulations: ten fabrics by sixteen frictions, or a spread of sixteen of them.

    python benchmarks/cloth_grid.py [--vertices 21] [--spread] [--self-friction 0.5] [--out cloth-grid.jsonl]

Each simulation becomes a line of JSON when it is done, and a run goes on where a file ends. The ratio |Ft|/Fn is that
of the floor's force from the balance of momentum, over the frames 22 to 29 s along a leg; `ratio_error` is its median
over mu, less one. With `--self-friction` the cloth feels itself: `least_distance` is then that of its parts at the ends
of all steps, over the thickness.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from stickslip_sim_core import build_info, drop_and_drag, fabric_names
from stickslip_sim_core.cloth.solver import THICKNESS
from stickslip_sim_core.stage import DRAG, DROP, LEGS, duration_of

FRICTIONS = tuple(round(0.1 * i, 1) for i in range(16))


def points(spread: bool) -> list[tuple[str, float]]:
    """Return (fabric, mu) of the simulations."""
    fabrics = fabric_names()
    if not spread:
        return [(fabric, mu) for fabric in fabrics for mu in FRICTIONS]
    return [(fabrics[i % len(fabrics)], FRICTIONS[(3 * i + 2) % 16]) for i in range(16)]


def simulate(fabric: str, mu: float, vertices: int, preset: str, self_friction: float | None) -> dict[str, object]:
    """Run one and say how it went."""
    start = time.process_time()
    scene = drop_and_drag(fabric, mu, vertices=vertices, preset=preset, self_friction=self_friction)
    seconds = time.process_time() - start
    along = np.hypot(scene.contact_force[:, 0], scene.contact_force[:, 1]) / np.maximum(
        scene.contact_force[:, 2], 1e-12
    )
    legs = np.array([duration_of(DROP) + leg * duration_of(DRAG) for leg in range(LEGS)])
    since = scene.times[:, None] - legs
    ratio = float(np.median(along[((since > 22.0) & (since < 29.0)).any(axis=1)]))
    return {
        "material": fabric,
        "mu": mu,
        "vertices": vertices,
        "preset": preset,
        "self_friction": self_friction,
        "build": build_info().build_hash[:12],
        "cpu_s": round(seconds, 1),
        "valid": scene.valid,
        "reason": scene.reason,
        "steps": scene.steps,
        "unconverged_steps": scene.unconverged_steps,
        "worst_residual": scene.worst_residual,
        "bias_side": scene.bias_side,
        "landed_side": scene.landed_side,
        "least_distance": scene.least_distance / THICKNESS,
        "crossed_frames": int((scene.self_intersections > 0).sum()),
        "ratio_error": ratio / mu - 1.0 if mu > 0.0 else ratio,
    }


def main() -> None:
    """Simulate what the file has not yet, and sum up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vertices", type=int, default=21)
    parser.add_argument("--spread", action="store_true")
    parser.add_argument("--preset", default="certified")
    parser.add_argument("--self-friction", type=float)
    parser.add_argument("--out", type=Path, default=Path("cloth-grid.jsonl"))
    args = parser.parse_args()
    rows = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    done = {(row["material"], row["mu"], row["vertices"], row["preset"], row["self_friction"]) for row in rows}
    for fabric, mu in points(args.spread):
        if (fabric, mu, args.vertices, args.preset, args.self_friction) in done:
            continue
        rows.append(simulate(fabric, mu, args.vertices, args.preset, args.self_friction))
        with args.out.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
        print(rows[-1], flush=True)
    steps = sum(row["steps"] for row in rows)
    print(
        f"{len(rows)} simulations, {sum(row['valid'] for row in rows)} valid, "
        f"{sum(row['unconverged_steps'] for row in rows)} of {steps} steps unconverged, "
        f"{sum(row['crossed_frames'] > 0 for row in rows)} cross themselves in some frame, "
        f"least distance {min(row['least_distance'] for row in rows):.3f} of the thickness, "
        f"most unconverged {max(row['unconverged_steps'] / row['steps'] for row in rows):.2%}, "
        f"CPU s median {np.median([row['cpu_s'] for row in rows]):.1f}, sum {sum(row['cpu_s'] for row in rows):.0f}, "
        f"ratio error at most {max(abs(row['ratio_error']) for row in rows):.1e}"
    )


if __name__ == "__main__":
    main()
