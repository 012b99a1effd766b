"""Contact of cloth with cloth: what it costs, whether anything crosses in any step, and its protocols.

    python benchmarks/cloth_contact.py [camel] [overhead] [stretched] [drops] [protocols] [--only PREFIX]

`camel`: camel-ponte-roma, which folds onto itself, at mu 0.5 and 21 x 21 over 300 frames, with and without contact
with itself. `overhead`: gray-interlock at 41 x 41 over 60 frames, in which nothing touches.
`stretched`: gray-interlock at mu 0.5 over a stretched cloth and over a bare floor, 50 frames. `drops`: sheets fall, are
crumpled, fold and pile up, and every step is looked at for crossings by comparing all edges with all triangles.
`protocols`: those of contact, with their settings. Without a name all of them run; `--only pile` leaves out the drops
and protocols whose names begin otherwise.
"""

import argparse
import time
from collections.abc import Callable, Sequence

from numpy.typing import ArrayLike
from stickslip_sim_core import (
    Body,
    Cloth,
    SelfContact,
    drop_and_drag,
    drop_on_cloth,
    fabric,
    plane,
    preset_named,
    protocols,
    self_intersections,
    stage,
)
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import THICKNESS
from stickslip_sim_core.scenes import tumbles

PROTOCOLS = ("capstan", "pull-out", "heavy-fold", "stacked-incline")
UNCONVERGED_SHARE_MAX = 0.002


def dragged(material: str, vertices: int, frames: int, mu: float | None) -> tuple[float, Cloth, int]:
    """Drop and drag at mu 0.5; return CPU seconds, the cloth, and how many of its steps end with a crossing.

    The seconds are without the hanging and without looking for crossings.
    """
    mesh = meshes.grid(stage.SIDE, stage.SIDE, vertices - 1, vertices - 1)
    held = stage.held_by_holders(mesh)
    hung = stage.hang(mesh, fabric(material), seed=0)
    feels = None if mu is None else SelfContact(mu)
    cloth = Cloth(mesh, fabric(material), preset_named("certified"), held=held, self_contact=feels)
    cloth.set_state(hung.positions)
    motion = stage.motion_of(cloth, [plane(0.5)], hung.positions[held], hung.tilt)
    crossed = looking = 0.0

    def watched(at: float) -> tuple[Floats, ArrayLike, Sequence[Body]]:
        nonlocal crossed, looking
        begin = time.process_time()
        crossed += self_intersections(cloth.positions, mesh.triangles) > 0
        looking += time.process_time() - begin
        return motion(at)

    begin = time.process_time()
    for frame in range(1, frames):
        cloth.advance(frame / stage.FRAME_RATE, watched)
    return time.process_time() - begin - looking, cloth, int(crossed)


def compare(material: str, vertices: int, frames: int) -> None:
    seconds = {}
    for mu in (None, 0.5):
        seconds[mu], cloth, crossed = dragged(material, vertices, frames, mu)
        print(
            f"{material} {vertices} x {vertices}, {frames} frames, contact with itself {mu}: {seconds[mu]:.2f} CPU s, "
            f"{cloth.unconverged_steps} of {cloth.steps} steps unconverged, {crossed} end with a crossing, "
            f"{cloth.newton} iterations, least distance {cloth.least_distance / THICKNESS:.4f} thicknesses, "
            f"{ {name: round(value, 2) for name, value in cloth.phases().items()} }",
            flush=True,
        )
    print(f"  ratio {seconds[0.5] / seconds[None]:.2f}", flush=True)


def stretched(vertices: int, frames: int) -> None:
    """Drag a cloth over a floor and over a stretched cloth of as many vertices."""
    begin = time.process_time()
    drop_and_drag("gray-interlock", 0.5, vertices=vertices, frames=frames)
    between = time.process_time()
    cloth = drop_on_cloth("gray-interlock", "11oz-black-denim", 0.5, vertices=vertices, frames=frames)
    seconds = between - begin, time.process_time() - between
    print(
        f"{vertices} x {vertices}, {frames} frames, over a floor {seconds[0]:.1f} CPU s, over a stretched cloth "
        f"{seconds[1]:.1f}: {seconds[1] / seconds[0]:.1f} times; {cloth.unconverged_steps} of {cloth.steps} steps "
        f"unconverged, least distance {cloth.least_distance / THICKNESS:.4f} thicknesses, "
        f"{(cloth.self_intersections > 0).sum()} frames cross",
        flush=True,
    )


def stretch_all() -> None:
    for vertices in (21, 41):
        stretched(vertices, 50)


def tumble_all(only: str) -> None:
    failed = []
    for name in tumbles.TUMBLES:
        if not name.startswith(only):
            continue
        seen = tumbles.watch(tumbles.tumble(name))
        print(
            f"{name:11} {seen.seconds:7.2f} CPU s, {seen.unconverged_steps:3d} of {seen.steps:3d} steps unconverged, "
            f"{seen.crossing_steps:3d} cross, least distance {seen.least_distance:.4f} thicknesses, "
            f"{seen.newton / seen.steps:6.1f} iterations a step",
            flush=True,
        )
        if seen.crossing_steps or seen.unconverged_steps > UNCONVERGED_SHARE_MAX * seen.steps:
            failed.append(name)
    print(f"beyond a share of {UNCONVERGED_SHARE_MAX:g} unconverged, or crossing: {', '.join(failed) or 'none'}")


def measure_all(only: str) -> None:
    for name in PROTOCOLS:
        if name.startswith(only):
            measure(name)


def measure(name: str) -> None:
    begin = time.process_time()
    result = protocols.run(name, "certified")
    print(f"{name}: error {result.error:.2g} of {result.tolerance:g}, {time.process_time() - begin:.0f} CPU s")
    for curve in result.curves:
        print("  ", dict(curve.parameters), [f"{error:+.2e}" for error in curve.errors])
    print("  ", dict(result.settings), flush=True)


PARTS: dict[str, Callable[[str], None]] = {
    "camel": lambda _: compare("camel-ponte-roma", 21, 300),
    "overhead": lambda _: compare("gray-interlock", 41, 60),
    "stretched": lambda _: stretch_all(),
    "drops": tumble_all,
    "protocols": measure_all,
}


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; none: all")
    parser.add_argument("--only", default="", help="how names of drops and protocols begin")
    given = parser.parse_args()
    asked = given.parts or list(PARTS)
    for part in asked:
        if part not in PARTS:
            parser.error(f"parts: must be of {', '.join(PARTS)}, got {part}")
        PARTS[part](given.only)


if __name__ == "__main__":
    main()
