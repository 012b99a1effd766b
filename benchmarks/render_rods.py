"""What a rod's view costs in CPU time and how far it is from a 256-sample reference, by quality.

Runs in Blender's interpreter:  .venv-blender/bin/python benchmarks/render_rods.py [--rods N]
[--all]

PSNR is given twice: over the whole frame, most of which is even ground, and over the pixels that
the rod touches. CPU time is all of a rod's four views (mesh, cameras, Cycles, pixels out) over
four, the median over rods after a first one.
"""

import argparse
import platform
import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from stickslip_blender.cycles.engine import SAMPLING, Sampling, import_bpy
from stickslip_blender.scenes.rod_hang import GROUND_LEVEL, POINTS, RodRenderer, silicone_color
from stickslip_schemas.spec.cameras import load_rig

REFERENCE = Sampling(samples=256, seed=1)
"""What pictures are compared with; its seed is another, so that it shares no noise with them."""
FURTHER_SAMPLINGS = {
    f"{samples}{'' if denoiser == 'none' else ' ' + denoiser}": Sampling(
        samples=samples, denoiser=denoiser
    )
    for samples in (4, 8, 16, 32, 64, 128)
    for denoiser in ("none", "guided")
}


@dataclass(frozen=True)
class Measured:
    """Views of all rods, (rods, cameras, height, width, 3), and the median CPU time of one [ms]."""

    views: npt.NDArray[np.uint8]
    milliseconds: float


def curls(count: int) -> npt.NDArray[np.float64]:
    """Return hanging curls of length 1, from nearly straight to tight, (count, POINTS, 3)."""
    random = np.random.Generator(np.random.PCG64(0))
    s = np.linspace(0.0, 1.0, POINTS)
    lines = []
    for turns, opening in zip(
        random.uniform(1.0, 5.0, count), random.uniform(0.3, 1.3, count), strict=True
    ):
        tilt, turn = opening * np.sqrt(s), 2.0 * np.pi * turns * s**1.3
        tangent = np.stack(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)], axis=1
        )
        steps = 0.5 * (tangent[1:] + tangent[:-1]) / (POINTS - 1)
        lines.append(np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))
    return np.stack(lines)


def measure(sampling: Sampling, lines: npt.NDArray[np.float64]) -> Measured:
    rig, views, seconds = load_rig("rod-4"), [], []
    renderer = RodRenderer(quality=sampling)
    renderer.render(lines[-1], rig[:1], color=silicone_color(0))
    for seed, line in enumerate(lines):
        start = time.process_time()
        views.append(renderer.render(line, rig, color=silicone_color(seed)))
        seconds.append((time.process_time() - start) / len(rig))
    return Measured(np.stack(views), 1e3 * float(np.median(seconds)))


def psnr(views: npt.NDArray[np.uint8], reference: npt.NDArray[np.uint8]) -> float:
    error = views.astype(np.float64) - reference
    return float(10.0 * np.log10(255.0**2 / np.mean(error**2)))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--rods", type=int, default=8, help="how many rods, each seen four times"
    )
    arguments.add_argument(
        "--all", action="store_true", help="other samplings too, not only the named ones"
    )
    options = arguments.parse_args()

    lines = curls(options.rods)
    reference = measure(REFERENCE, lines)
    rod = reference.views.max(axis=-1) > GROUND_LEVEL + 2
    app = import_bpy().app
    print(f"bpy {app.version_string} ({app.build_hash.decode()}), {platform.machine()}, one thread")
    print(f"{options.rods} rods x 4 views; the rod covers {100 * rod.mean():.1f} % of the pixels")
    print(
        f"{'quality':10} {'samples':>7} {'denoiser':>8} {'CPU ms/view':>11} {'PSNR frame':>10} "
        f"{'PSNR rod':>8}"
    )
    named: dict[str, Sampling] = {str(name): sampling for name, sampling in SAMPLING.items()}
    for name, sampling in (named | (FURTHER_SAMPLINGS if options.all else {})).items():
        result = measure(sampling, lines)
        quality = [
            psnr(result.views, reference.views),
            psnr(result.views[rod], reference.views[rod]),
        ]
        print(
            f"{name:10} {sampling.samples:7} {sampling.denoiser:>8} {result.milliseconds:11.0f} "
            f"{quality[0]:10.1f} {quality[1]:8.1f}"
        )
    print(
        f"{'reference':10} {REFERENCE.samples:7} {REFERENCE.denoiser:>8} "
        f"{reference.milliseconds:11.0f}"
    )


if __name__ == "__main__":
    main()
