"""Simulating a scene of the user's own from the command line: the workers' own program does it."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from stickslip_schemas.spec.scene_file import SceneFile

from stickslip_services.errors import CommandError


class SimulateError(CommandError):
    """A scene that was not simulated."""


def simulate(
    scene: SceneFile, folder: Path, out: Path, *, certificate: Path | None, allow_uncertified: bool, obj: bool
) -> dict[str, Any]:
    """Run a scene whose files are in `folder`, which tells of its progress on stderr; return what `scene.json` says.

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
