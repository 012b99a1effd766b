"""Simulation of custom scenes by the workers' program."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from stickslip_schemas.spec.scene_file import SceneFile

from stickslip_services.errors import CommandError


class SimulateError(CommandError):
    """The scene was not simulated."""


def simulate(
    scene: SceneFile, folder: Path, out: Path, *, certificate: Path | None, allow_uncertified: bool, obj: bool
) -> dict[str, Any]:
    """Simulate a scene whose files are in `folder`, with progress on standard error; return what `scene.json` holds.

    Raises:
        SimulateError: It was not run.
    """
    with tempfile.TemporaryDirectory(prefix="stickslip-scene-") as temporary:
        file = Path(temporary) / "scene.json"
        file.write_text(scene.model_dump_json(), encoding="utf-8")
        program = [
            sys.executable,
            "-m",
            "stickslip_workers",
            "scene",
            str(file),
            "--folder",
            str(folder),
            "--out",
            str(out),
        ]
        program += [] if certificate is None else ["--certificate", str(certificate)]
        program += ["--allow-uncertified"] if allow_uncertified else []
        program += ["--obj"] if obj else []
        try:
            ended = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=False)
        except OSError as error:
            raise SimulateError(f"the workers' program does not start: {error}") from error
    if ended.returncode not in (0, 1) or not ended.stdout.strip():
        raise SimulateError("the scene was not simulated; the workers' program says why above")
    result: dict[str, Any] = json.loads(ended.stdout)
    return result
