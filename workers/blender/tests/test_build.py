"""The build digest is over what is rendered with, and nothing else."""

import shutil
import subprocess
import sys
from pathlib import Path

import stickslip_blender
from stickslip_blender.build import build_digest

_SAY = "from stickslip_blender.build import build_digest; print(build_digest())"


def _digest_of_copy(folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", _SAY], capture_output=True, text=True, check=True, env={"PYTHONPATH": str(folder)}
    )
    return done.stdout.strip()


def test_the_digest_does_not_depend_on_the_place_but_on_every_source(tmp_path: Path) -> None:
    copy = tmp_path / "stickslip_blender"
    shutil.copytree(Path(stickslip_blender.__file__).parent, copy)
    assert _digest_of_copy(tmp_path) == build_digest()
    with (copy / "rods.py").open("a") as file:
        file.write("# changed\n")
    assert _digest_of_copy(tmp_path) != build_digest()
