"""How many samples of each built-in scene are valid, and what they cost.

    python benchmarks/scenes.py [SCENE ...] [--samples 16] [--seconds 4000] [--defaults] [--keep
                                DIR] [--out FILE]

Simulates each scene at the mesh and the preset of its file. All parameters vary together: numbers
over their declared ranges as a Sobol sequence, fabrics over all that are built in. No more samples
of a scene begin once it has cost `--seconds` of CPU. `--defaults` gives the first sample the
default parameters. DIR gets the arrays of each sample. Writes a row for each scene as soon as it is
done, and keeps the rows of other scenes that FILE has.
"""

import argparse
import json
import os
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.scene.library import built_in_files, load_scene, scene_names
from stickslip_schemas.spec.axes import SobolAxis, drawn_values
from stickslip_schemas.spec.names import Material
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes import cloth_scene

OUT = Path(__file__).parent / "results/scenes.json"
COMMAND = "python benchmarks/scenes.py"


def spec(name: str, samples: int, *, defaults: bool) -> Any:
    """Return the spec of a scene in which all parameters vary."""
    scene = load_scene(name)
    axes: dict[str, Any] = {}
    for dimension, (parameter, parameter_range) in enumerate(scene.parameters.items()):
        default = scene.default(parameter)
        if isinstance(default, str):
            fabrics = [str(value) for value in parameter_range.values or Material]
            values: list[Any] = [fabrics[7 * sample % len(fabrics)] for sample in range(samples)]
        else:
            sobol = SobolAxis[float](
                type="sobol",
                low=parameter_range.low or 0.0,
                high=parameter_range.high or 0.0,
                num=samples,
            )
            values = drawn_values(sobol, dimension=dimension).tolist()
        axes[parameter] = [default, *values[1:]] if defaults else values
    cameras = scene.looks.cameras
    viewpoint = next(iter(cameras)) if isinstance(cameras, dict) else "front"
    looks = {"texture": ["checker"] * samples, "viewpoint": [viewpoint] * samples}
    return job_spec_adapter.validate_python(
        {
            "kind": "cloth_scene",
            "scene": name,
            "combine": "zip",
            "frames": 2,
            "allow_uncertified": True,
            "axes": axes | looks,
        }
    )


class Clock:
    """CPU seconds in some calls."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)

    def of(self, name: str, called: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does the same and counts its time."""

        def timed(*arguments: Any, **named: Any) -> Any:
            begin = time.process_time()
            try:
                return called(*arguments, **named)
            finally:
                self.spent[name] += time.process_time() - begin

        return timed


def simulated(simulation: Any, files: dict[str, bytes], keep: Path | None) -> dict[str, Any]:
    """Return the outcome of a sample.

    It has its code, its reason if it is not valid, and CPU seconds by part.
    """
    begin, clock = time.process_time(), Clock()
    inputs = simulation.inputs(files.__getitem__)
    scene = cloth_scene.scene(inputs["scene"], seed=inputs["seed"])
    set_up = time.process_time() - begin
    scene = replace(
        scene,
        motion=clock.of("motion", scene.motion),
        holders=[replace(holder, pose=clock.of("motion", holder.pose)) for holder in scene.holders],
        forces=clock.of("forces", scene.forces),
    )
    step, Cloth.advance = Cloth.advance, clock.of("steps", Cloth.advance)  # type: ignore[method-assign]
    try:
        outcome = scene.outcome()
    finally:
        Cloth.advance = step  # type: ignore[method-assign]
    cpu = time.process_time() - begin
    layer = {
        "set-up": set_up,
        "motion": clock.spent["motion"],
        "contacts and forces of frames": clock.spent["forces"],
        "checks and other arrays": cpu - set_up - clock.spent["steps"] - clock.spent["forces"],
    }
    if keep is not None:
        np.savez(keep, allow_pickle=False, **outcome.record)
    return {
        "code": outcome.code if outcome.reason else "",
        "reason": outcome.reason,
        "cpu": cpu,
        "layer": layer,
    }


def row(
    name: str, samples: int, seconds: float, *, defaults: bool, keep: Path | None
) -> dict[str, Any]:
    """Simulate samples of a scene, and return its row."""
    files, measured = dict(built_in_files()), commit()
    job_spec = spec(name, samples, defaults=defaults)
    stage = job_spec.stage
    simulations: list[dict[str, Any]] = []
    for point in job_spec.grid():
        if sum(each["cpu"] for each in simulations) > seconds:
            break
        values = {key: value for key, value in point.items() if key in stage.parameters}
        simulations.append(
            simulated(
                job_spec.simulation(point), files, keep and keep / f"{name}-{len(simulations)}.npz"
            )
            | {"values": values}
        )
        print(
            name,
            len(simulations),
            f"{simulations[-1]['cpu']:.1f} s",
            values,
            simulations[-1]["reason"] or "valid",
            flush=True,
        )
    vertices = sum(sheet.mesh.shape[0] for sheet in stage.sheets.values())
    length = (stage.frames - 1) / stage.frame_rate
    cpu = [each["cpu"] for each in simulations]
    share = {
        part: sum(each["layer"][part] for each in simulations) / sum(cpu)
        for part in simulations[0]["layer"]
    }
    return {
        "scene": name,
        "preset": stage.preset.value,
        "vertices": vertices,
        "scene seconds": round(length, 2),
        "samples": len(simulations),
        "valid": sum(not each["reason"] for each in simulations),
        "not valid": [
            {key: each[key] for key in ("code", "reason", "values")}
            for each in simulations
            if each["reason"]
        ],
        "CPU s a sample, least, median, most": [
            round(value, 1) for value in (min(cpu), median(cpu), max(cpu))
        ],
        "CPU ms a vertex and scene second, least, median, most": [
            round(1e3 * value / vertices / length, 2) for value in (min(cpu), median(cpu), max(cpu))
        ],
        "share of CPU outside the solver's steps, %": {
            part: round(100 * value, 2) for part, value in share.items()
        },
        "commit": measured,
    }


def commit() -> str:
    """Return the commit that is measured."""
    result = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True
    )
    return result.stdout.strip()


def main() -> None:
    """Run the scenes one after another."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "scenes", nargs="*", choices=[[], *scene_names()], metavar="SCENE", default=[]
    )
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=4000.0)
    parser.add_argument("--defaults", action="store_true")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    for name in args.scenes or scene_names():
        scene_row = row(name, args.samples, args.seconds, defaults=args.defaults, keep=args.keep)
        old = json.loads(args.out.read_text())["rows"] if args.out.exists() else []
        rows = sorted(
            [*(each for each in old if each["scene"] != name), scene_row],
            key=lambda each: each["scene"],
        )
        record = {
            "what": "Validity and CPU time of the built-in scenes, all parameters over their "
            "declared ranges",
            "command": COMMAND,
            "commit": commit(),
            "conditions": "one thread; two cores shared with other work; CPU time of this process",
            "rows": rows,
        }
        args.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
