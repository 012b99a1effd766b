"""CPU seconds of drop-and-drag, by phase, on meshes of 21, 41 and 81 vertices a side.

    python benchmarks/cloth.py [--vertices 21 41 81] [--mu 0.5] [--material gray-interlock] [--preset certified]

Prints, for the whole motion of 131 s in one thread, CPU seconds, also per simulated second, the phases, and what
the steps took. The reference is ARGUS on 1,600 vertices: 300 CPU s per simulated second (docs/measurements.md).
"""

import argparse
import time

import numpy as np
from stickslip_sim_core import PRESETS, Cloth, build_info, fabric, fabric_names, plane
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.scenes import cloth_drag as scenes


def run(material: str, mu: float, preset: str, vertices: int) -> None:
    """Drive the cloth through the stage's whole path, as scenes.drop_and_drag does, and print a line."""
    settings = PRESETS[preset]
    mesh = meshes.grid(scenes.SIDE, scenes.SIDE, vertices - 1, vertices - 1)
    held = scenes.held_by_holders(mesh)
    cloth = Cloth(mesh, fabric(material), settings, held=held)
    floor = [plane(mu)]
    start = time.process_time()
    hung, tilt = scenes.hang(cloth, floor, seed=0)
    steps = int(np.ceil(scenes.DURATION / settings.time_step))
    dt = scenes.DURATION / steps
    for step in range(1, steps + 1):
        scenes.drag(cloth, floor, hung, tilt, step * dt, dt)
    cpu = time.process_time() - start
    phases = ", ".join(f"{name} {seconds:.1f}" for name, seconds in cloth.phases().items())
    print(
        f"| {vertices} | {cpu:.1f} | {cpu / scenes.DURATION:.2f} | {phases} | {cloth.newton / cloth.steps:.2f} "
        f"| {cloth.krylov / cloth.steps:.1f} | {cloth.factorizations / cloth.steps:.2f} | {cloth.unconverged_steps} |",
        flush=True,
    )


def main() -> None:
    """Run the meshes one after another."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vertices", type=int, nargs="+", default=[21, 41, 81])
    parser.add_argument("--mu", type=float, default=0.5)
    parser.add_argument("--material", choices=fabric_names(), default="gray-interlock")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="certified")
    args = parser.parse_args()
    print(f"{args.material}, mu {args.mu}, {args.preset}, core {build_info().build_hash[:12]}")
    print("| vertices a side | CPU s | per simulated s | phases [s] | Newton | GMRES | factors a step | unconverged |")
    print("|---|---|---|---|---|---|---|---|")
    for vertices in args.vertices:
        run(args.material, args.mu, args.preset, vertices)


if __name__ == "__main__":
    main()
