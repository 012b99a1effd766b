"""The build hash follows sources, flags and instruction set, and neither folder nor time."""

import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from stickslip_sim_core import build_info
from stickslip_sim_core._sim_core import kernels

SOURCE = Path(__file__).parents[1]


def configure(source: Path, build: Path, *options: str) -> str:
    """Configure with CMake and return the build hash that it prints."""
    site = sysconfig.get_path("purelib")
    command = [
        str(Path(sys.executable).with_name("cmake")),
        "-S",
        str(source),
        "-B",
        str(build),
        f"-DCMAKE_PREFIX_PATH={site}",
    ]
    command += [f"-Dnanobind_ROOT={site}/nanobind/cmake", "-DCMAKE_BUILD_TYPE=Release", *options]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    match = re.search(r"build hash ([0-9a-f]{64})", result.stdout)
    assert match, result.stdout
    return match[1]


def test_fields() -> None:
    info = build_info()
    assert re.fullmatch(r"[0-9a-f]{64}", info.build_hash)
    assert re.fullmatch(r"\d+\.\d+\.\d+", info.version)
    assert re.match(r"3\.4", info.eigen)
    assert info.compiler
    assert info.isa
    assert info.rod_kernel
    assert info.cloth_kernel in kernels()


@pytest.mark.physics
def test_hash_follows_what_matters(tmp_path: Path) -> None:
    def copy(name: str) -> Path:
        ignored = shutil.ignore_patterns("build", "__pycache__")
        return Path(shutil.copytree(SOURCE, tmp_path / name, ignore=ignored))

    here = configure(copy("here"), tmp_path / "build-here")
    elsewhere = configure(copy("elsewhere"), tmp_path / "build-elsewhere")
    assert here == elsewhere
    assert configure(tmp_path / "here", tmp_path / "build-here", "-DSIM_CORE_ISA=x86-64-v3") != here
    assert (
        configure(
            tmp_path / "here",
            tmp_path / "build-here",
            "-DSIM_CORE_ISA=",
            "-DCMAKE_CXX_FLAGS=-fno-inline",
        )
        != here
    )
    source = tmp_path / "elsewhere" / "src" / "rods" / "newton.hpp"
    source.write_text(source.read_text() + "// \n")
    assert configure(tmp_path / "elsewhere", tmp_path / "build-elsewhere") != here
