"""Two pictures of derivatives of runs: at an event, and beside a branch.

    python benchmarks/derivative_pictures.py FOLDER

They are for docs/tutorial-derivatives.md: FOLDER/derivative-event.png and derivative-branch.png.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter
from stickslip_sim_core.scenes.holders import Hang
from stickslip_sim_core.scenes.scene import Scene

SLOPE = np.deg2rad(25.0)
BESIDE = 0.46
"""Friction just below tan 25 degrees, at which differences are taken."""

TRUTH = 0.4
"""Friction of the drag that is observed."""

INSTANTS = np.linspace(10, 59, 6).astype(int)
"""Frames at which the drag is observed."""

SCAN = np.linspace(0.2, 0.6, 41)


def sheets() -> SceneFamily:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    down = np.tile(GRAVITY * np.array([np.sin(SLOPE), 0.0, -np.cos(SLOPE)]), (25, 1))

    def make(values: Mapping[str, float], _hang: Hang) -> Scene:
        floor = plane(values["mu"])
        return Scene(
            mesh=mesh,
            fabrics=[fabric("gray-interlock")],
            preset=preset_named("certified"),
            start=np.column_stack([mesh.rest, np.zeros(25)]),
            motion=lambda _time: (down, [floor]),
            frames=9,
            frame_rate=20.0,
        )

    return SceneFamily({"mu": SceneParameter(BESIDE, 0.0, 1.0)}, make)


def way(mu: float) -> float:
    """Return how far the sheet has slid after 0.4 s [m]."""
    x = sheets().scene(mu=mu).run().positions[:, :, 0]
    return float((x[-1] - x[0]).mean())


def way_by_mu(mu: float) -> tuple[float, float]:
    """Return the derivative of the way [m], and the distance of the nearest event."""
    by = sheets().with_values({"mu": mu}).differentiated(["mu"]).run().sensitivities["mu"]
    return float(by.positions[-1, :, 0].mean()), float(by.nearest_event[1:].min())


def draw_event(figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    scan = np.linspace(0.40, 0.54, 29)
    left.plot(scan, [1e3 * way(mu) for mu in scan], "k.", markersize=4, label="runs")
    for mu, colour in ((BESIDE, "tab:blue"), (0.5, "tab:orange")):
        slope = way_by_mu(mu)[0]
        near = mu + np.array([-0.035, 0.035])
        left.plot(near, 1e3 * (way(mu) + slope * (near - mu)), colour, label=f"tangent at {mu:g}")
    left.axvline(np.tan(SLOPE), color="0.6", linestyle=":")
    left.set(xlabel="friction mu", ylabel="way after 0.4 s [mm]")
    left.legend()
    draw_differences(right)


def draw_differences(axes: Axes) -> None:
    tangent, event = way_by_mu(BESIDE)
    steps = np.geomspace(1e-4, 0.1, 25)
    middle = way(BESIDE)
    ahead = np.array([way(BESIDE + h) for h in steps])
    behind = np.array([way(BESIDE - h) for h in steps])
    differences = {
        "to the right": (ahead - middle) / steps,
        "to the left": (middle - behind) / steps,
        "central": (ahead - behind) / (2.0 * steps),
    }
    for (name, difference), marker in zip(differences.items(), "osd", strict=True):
        axes.loglog(
            steps, np.abs(difference / tangent - 1.0), marker, markersize=4, label=name, alpha=0.8
        )
    axes.axvline(event, color="0.6", linestyle=":", label="nearest event")
    axes.set(xlabel="h", ylabel=f"error of the difference at mu {BESIDE:g}, relative")
    axes.legend()


def draw_branch(figure: Figure) -> None:
    axes = figure.subplots()
    drags = cloth_drag.family(
        "gray-interlock", TRUTH, mesh=11, preset="fast", frames=int(INSTANTS[-1]) + 1
    )
    observed = drags.scene().run().positions[INSTANTS]
    sizes = []
    for mu in SCAN:
        run = drags.with_values({"mu": float(mu)}).differentiated(["mu"]).run()
        residual = run.positions[INSTANTS] - observed
        by_mu = run.sensitivities["mu"].positions[INSTANTS]
        near = np.array([-0.006, 0.0, 0.006])
        axes.plot(mu + near, [root_mean_square(residual + h * by_mu) for h in near], "tab:blue")
        sizes.append(root_mean_square(residual))
    axes.plot(SCAN, sizes, "k.", markersize=5)
    axes.axvline(TRUTH, color="0.6", linestyle=":")
    axes.set(xlabel="friction mu", ylabel="residual [mm, root mean square]")


def root_mean_square(residual: Floats) -> float:
    return 1e3 * float(np.sqrt(np.mean(residual**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    for name, draw, size in (
        ("event", draw_event, (9.0, 3.6)),
        ("branch", draw_branch, (7.0, 3.6)),
    ):
        figure = Figure(figsize=size, dpi=110, layout="constrained")
        draw(figure)
        figure.savefig(arguments.folder / f"derivative-{name}.png")


if __name__ == "__main__":
    main()
