"""The rooms of this distribution: imports go one way, and never through more than a few floors."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import stickslip_services

ROOT = Path(stickslip_services.__file__).parent
MAX_FLOORS = 9
SERVER_ONLY = (
    "alembic",
    "fastapi",
    "prometheus_client",
    "pydantic_settings",
    "sqlalchemy",
    "standardwebhooks",
    "starlette",
    "uvicorn",
)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in ROOT.rglob("*.py") if "migrations" not in path.parts}


def imports(module: str) -> set[str]:
    """Return the modules of ours that a module imports, anywhere in its text."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found.update(
                name if (name := f"{node.module}.{alias.name}") in MODULES else node.module for alias in node.names
            )
    return {name for name in found if name in MODULES and name not in (module, "stickslip_services")}


def floors(module: str, above: tuple[str, ...] = ()) -> list[str]:
    """Return the longest chain of imports from a module down; fail where it comes back to itself."""
    assert module not in above, f"a circle of imports: {' -> '.join([*above, module])}"
    return _floors(module, above)


_known: dict[str, list[str]] = {}


def _floors(module: str, above: tuple[str, ...]) -> list[str]:
    if module not in _known:
        chains = [floors(other, (*above, module)) for other in sorted(imports(module))]
        _known[module] = [module, *max(chains, key=len, default=[])]
    return _known[module]


def test_no_circles_and_few_floors() -> None:
    tallest = max((floors(module) for module in MODULES), key=len)
    assert len(tallest) <= MAX_FLOORS, " -> ".join(tallest)


@cache
def room_of(module: str) -> str:
    return module.split(".")[1]


ALLOWED = {
    "database": set(),
    "access": {"database"},
    "catalog": {"database", "access"},
    "queue": {"catalog", "access", "database"},
    "pages": set(),
    "api": {"queue", "catalog", "access", "database", "pages"},
    "client": set(),
    "local": set(),
    "cli": {"client", "local", "access", "database"},
}
"""Which rooms the modules of a room may import, besides their own and the single modules beside the rooms."""


@pytest.mark.parametrize("room", ALLOWED)
def test_rooms_import_one_way(room: str) -> None:
    for module in MODULES:
        if module.startswith(f"stickslip_services.{room}."):
            rooms = {room_of(other) for other in imports(module)} & ALLOWED.keys() - {room}
            assert rooms <= ALLOWED[room], f"{module} imports from {rooms - ALLOWED[room]}"


BLOCKED = f"import sys\nsys.modules.update(dict.fromkeys({SERVER_ONLY!r}))\n"  # importing what is None fails


def run_without_server(code: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", BLOCKED + code], capture_output=True, text=True, check=False)


def test_the_client_needs_nothing_of_the_server() -> None:
    done = run_without_server("import stickslip_services.client, stickslip_services.client.pulling")
    assert (done.returncode, done.stderr) == (0, "")


def test_the_command_line_needs_nothing_of_the_server() -> None:
    run = "from stickslip_services.cli import app\nsys.argv = ['stickslip', {}]\napp()"
    done = run_without_server(run.format("'--help'"))
    assert done.returncode == 0, done.stderr
    assert "submit" in done.stdout
    assert "pull" in done.stdout
    done = run_without_server(run.format("'up', '--port', '0'"))
    assert done.returncode == 1
    assert "pip install 'stickslip-services[server]'" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
