"""Fit friction and bending of a drag to six noisy instants, from several truths and starts.

    python benchmarks/fit_friction.py MESH [--truths 0.2 0.6] [--starts 0 2] [--out RECORD]

For each true coefficient of friction, 0.2 to 1, the drag is simulated, and its vertices at six
instants get noise of 0.5 mm. Fits start from three pairs of mu and factor of bending. A fit is
right if it is within three standard deviations of the truth, or if it says that it may not be.
The standard deviations have a share of the run's steps; each row also has those by noise alone.
"""

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_sim_core.fit import Fit, fit
from stickslip_sim_core.observations import Vertices
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.family import SceneFamily

NOISE = 5e-4
"""Of each coordinate [m]."""

FRAMES = 60
"""Frames of a drag: 24.6 s, with the drop and most of a leg."""

TRUTHS = (0.2, 0.4, 0.6, 0.8, 1.0)
STARTS = ((0.3, 2.0), (0.6, 0.5), (0.9, 1.5))
BOUNDS = {"mu": (0.05, 2.0), "bending": (0.2, 5.0)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", type=int)
    parser.add_argument("--truths", type=float, nargs="+", choices=TRUTHS, default=TRUTHS)
    parser.add_argument(
        "--starts", type=int, nargs="+", choices=range(len(STARTS)), default=[0, 1, 2]
    )
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows = []
    for truth in arguments.truths:
        scenes = cloth_drag.family("gray-interlock", truth, mesh=arguments.mesh, frames=FRAMES)
        observation = _observed(scenes)
        for number in arguments.starts:
            rows.append(_row(scenes, observation, truth, STARTS[number]))
            print(json.dumps(rows[-1]), flush=True)
    within = sum(row["within_three_deviations"] for row in rows)
    warned = sum(bool(row["warning"]) for row in rows if not row["within_three_deviations"])
    summary = {"mesh": arguments.mesh, "within": within, "warned": warned, "fits": len(rows)}
    print(json.dumps(summary))
    if arguments.out:
        arguments.out.write_text(json.dumps({**summary, "rows": rows}, indent=2) + "\n")


def _observed(scenes: SceneFamily) -> Vertices:
    run = scenes.scene().run()
    frames = np.linspace(FRAMES / 6, FRAMES - 1, 6).astype(int)
    noise = NOISE * np.random.default_rng(1).standard_normal((6, run.positions.shape[1], 3))
    vertices = np.arange(run.positions.shape[1])
    return Vertices(frames.tolist(), run.positions[frames] + noise, vertices, NOISE)


def _row(
    scenes: SceneFamily, observation: Vertices, truth: float, start: tuple[float, float]
) -> dict[str, Any]:
    begin = time.process_time()
    result: Fit = fit(
        scenes,
        [observation],
        ["mu", "bending"],
        start={"mu": start[0], "bending": start[1]},
        bounds=BOUNDS,
    )
    true = {"mu": truth, "bending": 1.0}
    return {
        "truth": truth,
        "start": start,
        "values": dict(result.values),
        "deviations": dict(result.deviations),
        "by_noise": dict(result.by_noise),
        "by_steps": dict(result.by_steps),
        "within_three_deviations": _is_within(result.values, true, result.deviations),
        "within_three_by_noise": _is_within(result.values, true, result.by_noise),
        "mean_square": result.mean_square,
        "warning": result.warning,
        "runs": [search.runs for search in result.searches],
        "cpu_seconds": time.process_time() - begin,
    }


def _is_within(
    values: Mapping[str, float], true: Mapping[str, float], deviations: Mapping[str, float]
) -> bool:
    return all(abs(values[name] - true[name]) <= 3.0 * deviations[name] for name in true)


if __name__ == "__main__":
    main()
