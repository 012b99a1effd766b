"""Builds: a key depends on every file that its result is made with, and on no other."""

import ast
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.plan.builds import UNCOUNTED, sources
from stickslip_schemas.scene.library import load_scene
from stickslip_sim_core.protocols import CERTIFICATION
from stickslip_workers import builds
from stickslip_workers.builds import kind

STAGES = ("simulate", "pack")

SIMULATIONS = {
    "rod_hang": {"gamma": 50.0, "phi0": 1.0, "phi1": 6.0, "poisson": 0.5},
    "cloth_drag": {
        "material": "gray-interlock",
        "fabric": None,
        "mu": 0.5,
        "preset": "fast",
        "mesh": 5,
        "frames": 2,
    }
    | {"seed": 1, "self_friction": None},
    "cloth_scene": {
        "seed": 1,
        "scene": load_scene("belt")
        .physics_with(
            {
                ("end", "at_most"): 0.1,
                ("sheets", "cloth", "mesh", "cells", 0): 8,
                ("sheets", "cloth", "mesh", "cells", 1): 8,
            }
        )
        .model_dump(mode="json"),
    },
}

_RUN = """
import json, sys
ran = set()
def note(frame, event, argument):
    if event == "call" and frame.f_code.co_name != "<module>":
        ran.add(frame.f_code.co_filename)
from stickslip_schemas.store import DirectoryStore
from stickslip_schemas.documents.tasks import task_adapter
from stickslip_workers.stages.run import StageActor
actor = StageActor(sys.argv[2])
import stickslip_sim_core  # what is run at import is no work
from stickslip_schemas.kinds import KINDS
from stickslip_workers.builds import kind
for name in KINDS:
    kind(name)
sys.setprofile(note)
results = json.loads(actor.run(sys.argv[1]))
sys.setprofile(None)
print(json.dumps({"results": results, "ran": sorted(ran)}))
"""

_IMPORT = """
import sys
import stickslip_workers.stages.run, stickslip_workers.stages.pack, stickslip_workers.stages.publish
from stickslip_schemas.store import DirectoryStore
from stickslip_schemas.kinds import KINDS
from stickslip_workers.builds import kind
for name in KINDS:
    kind(name)
import stickslip_sim_core
for name, module in list(sys.modules.items()):
    if name.startswith("stickslip_") and module.__file__:
        print(module.__file__)
"""


def _python(script: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout


@cache
def _files(stage: str, name: str) -> set[Path]:
    return {path.resolve() for path in sources(builds.roots(stage, name), cut=UNCOUNTED).values()}


def _only_passes_on(path: Path) -> bool:
    """Return whether a file has imports, a docstring and `__all__` only."""
    return all(
        isinstance(node, ast.Import | ast.ImportFrom)
        or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        or (
            isinstance(node, ast.Assign)
            and [ast.unparse(target) for target in node.targets] in (["__all__"], ["__version__"])
        )
        for node in ast.parse(path.read_text()).body
    )


def _decides_on_nothing(path: Path) -> bool:
    """Documents only check what a key has as a whole, and say which files it names.

    A store finds bytes by digest, and `installation` has the words of its hints.
    """
    rooms = [("stickslip_schemas", room) for room in ("kinds", "scene", "store")]
    return path.parts[-3:-1] in rooms or path.name == "installation.py"


@pytest.mark.physics
@pytest.mark.parametrize("name", KINDS)
def test_every_function_that_runs_is_in_the_build(name: str, tmp_path: Path) -> None:
    """But for what decides on nothing."""
    task = {"stage": "simulate", "simulation": {"kind": name, **SIMULATIONS[name]}}
    answer = json.loads(_python(_RUN, json.dumps([task]), str(tmp_path)))
    assert answer["results"][0]["outcome"] == "succeeded", answer["results"]
    source_files = {
        Path(file).resolve()
        for file in answer["ran"]
        if "/stickslip_" in file and file.endswith(".py")
    }
    assert len(source_files) >= 5
    left = {path for path in source_files if not _decides_on_nothing(path)}
    assert left <= _files("simulate", name), left - _files("simulate", name)


@pytest.mark.physics
def test_every_module_that_is_imported_is_in_some_build() -> None:
    """A file that only passes names on, or that is compiled, is in none.

    The build of the core covers the latter.
    """
    covered = {path for name in KINDS for stage in STAGES for path in _files(stage, name)}
    registry = {
        path.resolve()
        for path in sources(["stickslip_schemas.kinds"]).values()
        if path.name == "__init__.py"
    }
    loose = [
        path
        for path in map(Path, _python(_IMPORT).split())
        if path.suffix == ".py"
        and path.resolve() not in covered | registry
        and not (_only_passes_on(path) or _decides_on_nothing(path))
    ]
    # Loaded with the package of the core, for people; no stage calls them, which the test above
    # would notice.
    unused = (
        "rods/clamp.py",
        "rods/fit.py",
        "rods/hung_rod.py",
        "rods/inverse.py",
        "rods/tilt.py",
        "protocols/",
        "reference/",
    )
    assert [
        str(path) for path in loose if not any(part in path.as_posix() for part in unused)
    ] == []


def test_a_kinds_own_files_are_in_its_builds_and_in_no_others() -> None:
    for name in KINDS:
        for stage in STAGES:
            for path in _files(stage, name):
                if path.parent.name in ("kinds", "scenes") and path.stem in KINDS:
                    assert path.stem == name, (stage, path)
        assert any(path.stem == name for path in _files("simulate", name))
        assert any(path.stem == name for path in _files("pack", name))


@pytest.mark.parametrize(
    ("file", "stage", "kinds"),
    [
        ("fabrics.toml", "simulate", set(KINDS) - {"rod_hang"}),
        ("names.py", "simulate", set()),
        ("names.py", "pack", set(KINDS) - {"rod_hang"}),
        ("arrays.py", "pack", set(KINDS)),
        ("codecs.py", "pack", set(KINDS)),
    ],
)
def test_a_new_fabric_makes_no_rod_again_and_a_new_texture_no_simulation(
    file: str, stage: str, kinds: set[str]
) -> None:
    of_schemas = "stickslip_schemas"
    held = {
        name
        for name in KINDS
        if any(
            path.name == file and (file == "fabrics.toml" or of_schemas in path.parts)
            for path in _files(stage, name)
        )
    }
    assert held == kinds


def test_every_build_is_another() -> None:
    builds_of_kinds = [builds.kind_builds(name) for name in KINDS]
    assert (
        len({build["simulate"] for build in builds_of_kinds})
        == len({build["pack"] for build in builds_of_kinds})
        == len(KINDS)
    )


@pytest.mark.parametrize("name", KINDS)
def test_a_certificate_is_of_the_solver_that_the_kind_uses(name: str) -> None:
    presets = [
        preset
        for preset, certification in CERTIFICATION.items()
        if certification.solver == kind(name).solver
    ]
    assert presets
    assert builds.kind_builds(name)["sim_core"] == builds.solver_build(
        CERTIFICATION[presets[0]].solver
    )
