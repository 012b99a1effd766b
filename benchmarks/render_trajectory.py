"""Simulate a drop-and-drag for the benchmarks of rendering, which run in another interpreter.

.venv/bin/python benchmarks/render_trajectory.py OUT.npz [--material M] [--mu MU] [--mesh N]
"""

import argparse
from pathlib import Path

import numpy as np
from stickslip_sim_core.scenes import cloth_drag


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("out", type=Path)
    arguments.add_argument("--material", default="gray-interlock")
    arguments.add_argument("--mu", type=float, default=0.3)
    arguments.add_argument("--mesh", type=int, default=41, help="vertices a side")
    options = arguments.parse_args()
    run = cloth_drag.scene(
        options.material, options.mu, preset="fast", mesh=options.mesh, seed=1
    ).run()
    if not run.valid:
        raise SystemExit(f"not valid: {run.reason}")
    np.savez(
        options.out, track=run.positions.astype(np.float32), rest=run.rest, triangles=run.triangles
    )


if __name__ == "__main__":
    main()
