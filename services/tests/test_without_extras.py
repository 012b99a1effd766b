"""The client and the command line work without the packages of the extras."""

import subprocess
import sys
from pathlib import Path

import pytest
from stickslip_services.cli.common import ARRAYS, shows_errors

ROOT = Path(__file__).parents[2]

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

# To import what is None fails.
BLOCKED = f"import sys\nsys.modules.update(dict.fromkeys({(*SERVER_ONLY, *sorted(ARRAYS))!r}))\n"


def run_without_extras(code: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", BLOCKED + code], capture_output=True, text=True, check=False
    )


@pytest.mark.real
def test_the_client_needs_no_extra() -> None:
    done = run_without_extras("import stickslip, stickslip_services.client.pulling")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.real
def test_the_command_line_needs_no_extra() -> None:
    run = "from stickslip_services.cli import app\nsys.argv = ['stickslip', {}]\napp()"
    done = run_without_extras(run.format("'--help'"))
    assert done.returncode == 0, done.stderr
    assert "submit" in done.stdout
    assert "pull" in done.stdout
    done = run_without_extras(run.format("'up', '--port', '0'"))
    assert done.returncode == 1
    assert "pip install ./schemas './services[server]'" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


@pytest.mark.real
@pytest.mark.parametrize(
    ("example", "status", "message"),
    [
        ("thesis-rods.yaml", 0, "10000 (train"),
        ("demo-cloth.yaml", 0, "the spec is valid"),
        (
            "fabric-cloth.yaml",
            1,
            "numpy is not installed: run `pip install ./schemas './services[arrays]'`",
        ),
    ],
)
def test_specs_are_checked_without_arrays_unless_their_axes_are_drawn(
    example: str, status: int, message: str
) -> None:
    words = [
        "stickslip",
        "validate",
        str(ROOT / "examples" / example),
        "--url",
        "http://127.0.0.1:9",
    ]
    done = run_without_extras(f"from stickslip_services.cli import app\nsys.argv = {words}\napp()")
    # Lines are wrapped at the width of the terminal.
    words_said = " ".join((done.stdout + done.stderr).split())
    assert (done.returncode, message in words_said) == (status, True), done.stderr


@pytest.mark.real
def test_a_dataset_is_not_opened_without_arrays() -> None:
    done = run_without_extras("from stickslip import Client\nClient().open('ds-0000000000000000')")
    assert "is not installed: run `pip install ./schemas './services[arrays]'`" in done.stderr


def test_only_what_the_extra_installs_is_said_to_be_in_it() -> None:
    @shows_errors
    def broken() -> None:
        raise ModuleNotFoundError("No module named 'click.gone'", name="click.gone")

    with pytest.raises(ModuleNotFoundError):
        broken()
