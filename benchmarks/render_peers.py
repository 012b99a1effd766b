"""What a picture costs with the settings of Kubric and BlenderProc, and with ours at the same decibels.

    .venv-blender/bin/python benchmarks/render_peers.py /tmp/cloth.npz [--frames 1] [--references DIR]

The peers' numbers are their defaults for Cycles: Kubric's 128 samples, adaptive, denoised (kubric/renderer/blender.py),
and BlenderProc's 1,024 samples with a noise threshold of 0.01, denoised, three bounces (DefaultConfig.py). Scene,
camera, frame and pixel filter are ours, so that only what they spend differs. A peer renders one picture at a time. For
a comparison at equal quality, the same settings are rendered with fewer samples, and the cost at our decibels is read
off between them. CPU seconds for a picture; decibels over the cloth, pooled, against 256 samples of another seed.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from render_cloth import COMPARED, TEXTURES, Bench, View, decibels, shots, squared
from stickslip_blender.engine import CLOTH_SAMPLING, Sampling
from stickslip_blender.multiplexed import encode
from stickslip_schemas.spec.jobs import Quality

LADDER = (8, 16, 32, 64)


@dataclass(frozen=True)
class Peer:
    """Settings of Cycles."""

    name: str
    samples: int
    adaptive: bool = True
    threshold: float = 0.01
    diffuse_bounces: int = 4
    glossy_bounces: int = 4
    max_bounces: int = 12


PEERS = (
    Peer("Kubric", 128),
    Peer("BlenderProc", 1024, diffuse_bounces=3, glossy_bounces=0, max_bounces=3),
)


@contextmanager
def settings_of(bench: Bench, peer: Peer) -> Iterator[None]:
    """Give the stage a peer's settings until the block ends."""
    cycles = bench.stage._scene.cycles
    theirs = {
        "use_adaptive_sampling": peer.adaptive,
        "adaptive_threshold": peer.threshold,
        "diffuse_bounces": peer.diffuse_bounces,
        "glossy_bounces": peer.glossy_bounces,
        "max_bounces": peer.max_bounces,
    }
    ours = {name: getattr(cycles, name) for name in theirs}
    for name, value in theirs.items():
        setattr(cycles, name, value)
    yield
    for name, value in ours.items():
        setattr(cycles, name, value)


def rendered(bench: Bench, peer: Peer, view: View) -> tuple[list[np.ndarray], float]:
    """Return the squared errors of the cloth's pixels, one array for each texture, and the CPU seconds of a picture."""
    expected = [bench.reference(view, texture) for texture in COMPARED]
    shot, floor = bench.set_up(view)
    cloth = bench.cloth(view, expected[0][0])
    errors, seconds = [], []
    with settings_of(bench, peer):
        for texture, (window, reference) in zip(COMPARED, expected, strict=True):
            start = time.process_time()
            light = bench.stage.direct(shot, bench.pictures[texture], Sampling(peer.samples, "guided", seed=7))
            seconds.append(time.process_time() - start)
            picture = encode(bench.stage.composer.on_floor(light, shot.points, bench.rig[view.view], floor))
            errors.append(squared(picture[window.slices], reference)[cloth].ravel())
    return errors, float(np.median(seconds))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("trajectory", type=Path)
    arguments.add_argument("--frames", type=int, default=1, help="instants, each in three views")
    arguments.add_argument("--references", type=Path, help="folder that keeps them")
    options = arguments.parse_args()
    bench = Bench(options.trajectory, options.references)
    views = list(shots(bench.track, options.frames, ("matt",)))
    bench.composed(views[0], CLOTH_SAMPLING[Quality.draft])  # shaders are compiled once
    rendered(bench, Peer("warm", 1), views[0])

    own: dict[str, tuple[float, float]] = {}
    for quality in (Quality.draft, Quality.standard, Quality.high):
        errors, seconds = [], []
        for view in views:
            pictures, light, other = bench.composed(view, CLOTH_SAMPLING[quality])
            seconds.append((light + other) / len(TEXTURES))
            for texture in COMPARED:
                window, reference = bench.reference(view, texture)
                error = squared(pictures[TEXTURES.index(texture)][window.slices], reference)
                errors.append(error[bench.cloth(view, window)].ravel())
        own[quality] = decibels(errors), float(np.median(seconds))
        print(f"ours, {quality}: {own[quality][1]:.3f} CPU s, {own[quality][0]:.1f} dB", flush=True)
    for peer in PEERS:
        found = []
        for samples in (*LADDER, peer.samples):
            at = Peer(**{**vars(peer), "samples": samples, "adaptive": samples == peer.samples})
            results = [rendered(bench, at, view) for view in views]
            level = decibels([error for errors, _ in results for error in errors])
            cost = float(np.median([seconds for _, seconds in results]))
            found.append((level, cost))
            print(f"{peer.name}, {samples} samples: {cost:.2f} CPU s, {level:.1f} dB", flush=True)
        levels, costs = np.array(found).T
        for name, (level, cost) in own.items():
            if levels.min() <= level <= levels.max():
                order = np.argsort(levels)
                equal = float(np.exp(np.interp(level, levels[order], np.log(costs[order]))))
                print(f"{peer.name} at the {level:.1f} dB of our {name}: {equal:.2f} CPU s, {equal / cost:.1f} x ours")


if __name__ == "__main__":
    main()
