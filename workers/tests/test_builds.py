"""Builds: what a key has to depend on is in its digest."""

import ast
from pathlib import Path

import stickslip_sim_core
import stickslip_workers
from stickslip_workers import builds

STAGES = Path(stickslip_workers.__file__).parent / "stages"
CORE = Path(stickslip_sim_core.__file__).parent


def _imports(path: Path) -> set[str]:
    """Return the modules of the core that a file imports, as file names; names from the package itself, too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "stickslip_sim_core":
            module = (node.module or "").removeprefix("stickslip_sim_core").strip(".")
            found |= {f"{module}.py"} if module else {f"{_home(alias.name)}.py" for alias in node.names}
    return found - {"_sim_core.py"}


def _home(name: str) -> str:
    """Return the module that the package takes a name from."""
    for node in ast.walk(ast.parse((CORE / "__init__.py").read_text())):
        if isinstance(node, ast.ImportFrom) and any(alias.name == name for alias in node.names):
            return (node.module or "").removeprefix("stickslip_sim_core.")
    return name


def test_the_digest_of_the_core_has_all_that_the_stages_call() -> None:
    waiting = set().union(*(_imports(STAGES / name) for name in builds._SIMULATING))
    assert {"rods.py", "scenes.py"} <= waiting
    seen: set[str] = set()
    while waiting:
        name = waiting.pop()
        seen.add(name)
        waiting |= _imports(CORE / name) - seen
    assert seen <= set(builds._FACE)
    assert {path.name for path in CORE.glob("*.toml")} <= set(builds._FACE)
    assert all((CORE / name).exists() for name in builds._FACE)
