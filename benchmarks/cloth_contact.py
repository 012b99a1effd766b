"""Contact of cloth with cloth: its cost, crossings in any step, and its protocols.

    python benchmarks/cloth_contact.py [camel] [overhead] [stretched] [facets] [drops] [momentum]
        [protocols] [--only PREFIX] [--figures FOLDER]

`camel`: camel-ponte-roma, which folds onto itself, at mu 0.5 and 21 x 21 over 300 frames, with and
without contact with itself. `overhead`: gray-interlock at 41 x 41 over 60 frames, in which nothing
touches. `stretched`: gray-interlock at mu 0.5 over a stretched cloth and over a bare floor, 50
frames and all 300. `facets`: capstan over cylinders of triangles, and over a cloth. `drops`: sheets
fall, fold, are crumpled and pile up; after every step all edges are compared with all triangles, to
see what crosses. `momentum`: what forces of pairs and their moments add up to. `protocols`: those
of contact, with their settings; the stacked incline is on four meshes. Without a name all of them
run; `--only pile` leaves out the drops and protocols whose names begin otherwise. With --figures
the pictures of the protocols are drawn, too (needs matplotlib).
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from stickslip_schemas.scene.library import load_scene
from stickslip_sim_core import (
    Body,
    Cloth,
    SelfContact,
    fabric,
    plane,
    preset_named,
    protocols,
    self_intersections,
)
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import THICKNESS
from stickslip_sim_core.protocols import capstan
from stickslip_sim_core.reference import master_curves
from stickslip_sim_core.scenes import cloth_drag, cloth_scene
from stickslip_sim_core.scenes.holders import Hands, Holder
from stickslip_testing import tumbles
from stickslip_testing.drums import OverCloth, OverTriangles

PROTOCOLS: Mapping[str, Mapping[str, Any]] = {
    "capstan": {},
    "pull-out": {},
    "heavy-fold": {"friction": (0.1, 0.3, 1.0)},
    "stacked-incline": {"structured": 2, "unstructured": 2},
}
UNCONVERGED_SHARE_MAX = 0.002


def dragged(
    material: str, vertices: int, frames: int, mu: float | None
) -> tuple[float, Cloth, int]:
    """Drop and drag at mu 0.5.

    Return CPU seconds, the cloth, and how many of its steps end with a crossing.

    The seconds are without the hanging and without looking for crossings.
    """
    mesh = meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, vertices - 1, vertices - 1)
    held = cloth_drag.held_by_holders(mesh)
    hung = cloth_drag.hang(mesh, fabric(material), seed=0)
    feels = None if mu is None else SelfContact(mu)
    cloth = Cloth(mesh, fabric(material), preset_named("certified"), held=held, self_contact=feels)
    cloth.set_state(hung.positions)
    hands = Hands([Holder(hung.held, cloth_drag.holder_pose)], hung.positions)
    motion = hands.driving(cloth_drag.motion_of(hung, plane(0.5)))
    crossed = looking = 0.0

    def watched(at: float) -> tuple[Floats, ArrayLike, Sequence[Body]]:
        nonlocal crossed, looking
        begin = time.process_time()
        crossed += self_intersections(cloth.positions, mesh.triangles) > 0
        looking += time.process_time() - begin
        return motion(at)

    begin = time.process_time()
    cloth.advance((frames - 1) / cloth_drag.FRAME_RATE, watched)
    return time.process_time() - begin - looking, cloth, int(crossed)


def compare(material: str, vertices: int, frames: int) -> None:
    seconds = {}
    for mu in (None, 0.5):
        seconds[mu], cloth, crossed = dragged(material, vertices, frames, mu)
        print(
            f"{material} {vertices} x {vertices}, {frames} frames, contact with itself {mu}: "
            f"{seconds[mu]:.2f} CPU s, "
            f"{cloth.total.unconverged} of {cloth.total.steps} steps unconverged, {crossed} end "
            "with a crossing, "
            f"{cloth.total.newton} iterations, least distance "
            f"{cloth.total.least_distance / THICKNESS:.4f} thicknesses",
            flush=True,
        )
    print(f"  ratio {seconds[0.5] / seconds[None]:.2f}", flush=True)


def stretched(vertices: int, frames: int) -> None:
    """Drag a cloth over a floor and over a stretched cloth of as many vertices."""
    begin = time.process_time()
    cloth_drag.scene("gray-interlock", 0.5, mesh=vertices, frames=frames, self_friction=None).run()
    between = time.process_time()
    document = load_scene("on-cloth").physics()
    document["duration"] = (frames - 1) / document["frame_rate"]
    for sheet in document["sheets"].values():
        sheet["mesh"]["cells"] = [vertices - 1] * 2
    cloth = cloth_scene.scene(document).run()
    seconds = between - begin, time.process_time() - between
    print(
        f"{vertices} x {vertices}, {frames} frames, over a floor {seconds[0]:.1f} CPU s, over a "
        "stretched cloth "
        f"{seconds[1]:.1f}: {seconds[1] / seconds[0]:.1f} times; "
        f"{cloth.labels['unconverged_steps']} of "
        f"{cloth.labels['steps']} steps unconverged, least distance "
        f"{cloth.least_distance / THICKNESS:.4f} "
        f"thicknesses, {(cloth.self_intersections > 0).sum()} frames cross",
        flush=True,
    )


def stretch_all() -> None:
    for vertices in (21, 41):
        for frames in (50, 300):
            stretched(vertices, frames)


def tumble_all(only: str) -> None:
    failed = []
    for name in tumbles.TUMBLES:
        if not name.startswith(only):
            continue
        tumble = tumbles.watch(tumbles.tumble(name))
        print(
            f"{name:11} {tumble.seconds:7.2f} CPU s, "
            f"{tumble.unconverged_steps:3d} of {tumble.steps:3d} steps unconverged, "
            f"{tumble.crossing_steps:3d} cross, least distance {tumble.least_distance:.4f} "
            "thicknesses, "
            f"{tumble.newton / tumble.steps:6.1f} iterations a step",
            flush=True,
        )
        if tumble.crossing_steps or tumble.unconverged_steps > UNCONVERGED_SHARE_MAX * tumble.steps:
            failed.append(name)
    print(
        f"beyond a share of {UNCONVERGED_SHARE_MAX:g} unconverged, or crossing: "
        f"{', '.join(failed) or 'none'}"
    )


def momentum(name: str, steps: int) -> None:
    tumble = tumbles.tumble(name)
    tumbles.watch(tumble, steps)
    sums = tumbles.balance(tumble.cloth)
    unit = THICKNESS * sums.size
    print(
        f"{name} after {steps} steps, {sums.pairs} pairs, over the sum of their sizes (times the "
        "thickness): force "
        f"{np.abs(sums.force).max() / sums.size:.1e}, moment "
        f"{np.linalg.norm(sums.moment) / unit:.3f}, less that of "
        "friction across the distance "
        f"{np.linalg.norm(sums.moment - sums.moment_of_friction) / unit:.1e}",
        flush=True,
    )


def momentum_all() -> None:
    for name, steps in (("folding-0", 100), ("drop-5", 60), ("pile-0", 15)):
        momentum(name, steps)


def over_facets() -> None:
    """Draw a strip over a round cylinder, and over cylinders of triangles.

    The triangles are as short as the cells, shorter and longer.

    Then over a held cloth on such a cylinder, which is rough, with strips of cells of 5 to 2.5
    degrees.
    """
    preset = preset_named("certified")
    of_cloth_cases = ((72, 60), (72, 120), (96, 120), (120, 90), (144, 60), (144, 120))
    for mu in capstan.FRICTION:
        strips: dict[str, capstan.Strip] = {"round": capstan.Strip(mu, 0.05, preset)}
        strips |= {
            f"{facets} facets": OverTriangles(mu, 0.05, preset, facets) for facets in (72, 60, 24)
        }
        for cells, facets in of_cloth_cases:
            strips[f"{cells} cells a turn, {facets} facets of cloth"] = OverCloth(
                mu, 0.05, preset, facets, cells
            )
        for name, strip in strips.items():
            heavy, wrap = strip.draw()
            cloth, expected = strip.cloth, np.log(master_curves.capstan(mu, wrap, 0.05))
            print(
                f"capstan, mu {mu}, {name}: "
                f"ln(T2/T1) {np.log(heavy.mean() / capstan.LIGHT) / expected - 1.0:+.2%}, "
                f"ripple {np.ptp(heavy) / heavy.mean():.2%}, "
                f"{strip.iterations:.1f} iterations a measured step, "
                f"{cloth.total.newton / cloth.total.steps:.1f} a step in all, "
                f"{cloth.total.unconverged} of {cloth.total.steps} steps unconverged",
                flush=True,
            )


def measure_all(only: str, figures: Path | None) -> None:
    for name, settings in PROTOCOLS.items():
        if name.startswith(only):
            measure(name, settings, figures)


def measure(name: str, settings: Mapping[str, Any], figures: Path | None) -> None:
    begin = time.process_time()
    result = protocols.run(name, "certified", **settings)
    print(
        f"{name}: error {result.error:.2g} of {result.tolerance:g}, "
        f"{time.process_time() - begin:.0f} CPU s"
    )
    for curve in result.curves:
        print("  ", dict(curve.parameters), [f"{error:+.2e}" for error in curve.errors])
    print("  ", dict(result.settings), flush=True)
    if figures:
        import plots

        plots.plot(result).savefig(figures / f"{name}.png")


PARTS: Mapping[str, Callable[[str], None]] = {
    "camel": lambda _: compare("camel-ponte-roma", 21, 300),
    "overhead": lambda _: compare("gray-interlock", 41, 60),
    "stretched": lambda _: stretch_all(),
    "drops": tumble_all,
    "momentum": lambda _: momentum_all(),
    "facets": lambda _: over_facets(),
}


def main() -> None:
    """Run the chosen parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parts = [*PARTS, "protocols"]
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(parts)}; none: all")
    parser.add_argument("--only", default="", help="how names of drops and protocols begin")
    parser.add_argument(
        "--figures", type=Path, help="folder to draw the pictures of the documentation into"
    )
    options = parser.parse_args()
    for part in options.parts:
        if part not in parts:
            parser.error(f"parts: must be of {', '.join(parts)}, got {part}")
    for part in options.parts or parts:
        if part == "protocols":
            measure_all(options.only, options.figures)
        else:
            PARTS[part](options.only)


if __name__ == "__main__":
    main()
