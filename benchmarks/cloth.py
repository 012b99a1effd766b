"""What drop-and-drag costs on meshes of 21, 41 and 81 vertices a side, beside what it cost before.

    python benchmarks/cloth.py [--vertices 21 41 81] [--mu 0.5] [--material gray-interlock]
                               [--preset certified] [--seconds 124.6]

Prints, for the motion in one thread, CPU seconds, steps, and what they took. `BEFORE` is the core
of November 2026 that stepped by 20 ms (gray-interlock, mu 0.5, `certified`, 131 s), on a machine
with little else to do.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from stickslip_sim_core import PRESETS, Cloth, build_info, fabric, fabric_names, plane
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.holders import Hands, Holder

BEFORE = {
    21: (13.3, 6359, 3.91, 13.6, 0.45),
    41: (82.3, 6359, 3.74, 15.5, 0.52),
    81: (1037.0, 6319, 7.2, 57.6, 1.9),
}
"""By vertices a side: CPU s, steps, and Newton, GMRES and factors a step; 81: those of 10 steps at
45.5 s.
"""


def run(material: str, mu: float, preset: str, vertices: int, seconds: float) -> None:
    """Drive the cloth as the drag scene does, and print a line."""
    mesh = meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, vertices - 1, vertices - 1)
    held = cloth_drag.held_by_holders(mesh)
    start = time.process_time()
    hung = cloth_drag.hang(mesh, fabric(material), seed=0)
    hanging = time.process_time() - start
    # As the drag scene does.
    settings = replace(PRESETS[preset], second_order=False)
    cloth = Cloth(mesh, fabric(material), settings, held=held)
    cloth.set_state(hung.positions)
    hands = Hands([Holder(hung.held, cloth_drag.holder_pose)], hung.positions)
    motion = hands.driving(cloth_drag.motion_of(hung, plane(mu)))
    floor = plane(mu).pose

    def path(times: Floats) -> tuple[Floats, Floats]:
        return hands.at(times), np.tile(floor, (len(times), 1, 1, 1))

    cloth.advance(seconds, motion, path=path)
    cpu = time.process_time() - start
    total, steps = cloth.total, cloth.total.steps
    print(
        f"| {vertices} | {cpu:.1f} | {hanging:.1f} | {steps} | {total.newton / steps:.2f} | "
        f"{total.krylov / steps:.1f} "
        f"| {total.factorizations / steps:.2f} | {1e3 * total.step_error:.2f} "
        f"| {total.unconverged} |",
        flush=True,
    )
    if vertices in BEFORE:
        cost, count, newton, krylov, factors = BEFORE[vertices]
        print(
            f"| {vertices}, before | {cost:.1f} | | {count} | {newton:.2f} | {krylov:.1f} | "
            f"{factors:.2f} | | 0 |"
        )


def main() -> None:
    """Run the meshes one after another."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vertices", type=int, nargs="+", default=[21, 41, 81])
    parser.add_argument("--mu", type=float, default=0.5)
    parser.add_argument("--material", choices=fabric_names(), default="gray-interlock")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="certified")
    parser.add_argument(
        "--seconds", type=float, default=(cloth_drag.FRAMES - 1) / cloth_drag.FRAME_RATE
    )
    args = parser.parse_args()
    print(f"{args.material}, mu {args.mu}, {args.preset}, core {build_info().build_hash[:12]}")
    names = "hanging [s] | steps | Newton | GMRES | factors a step | step error [mm] | unconverged"
    print(f"| vertices | CPU s | {names} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for vertices in args.vertices:
        run(args.material, args.mu, args.preset, vertices, args.seconds)


if __name__ == "__main__":
    main()
