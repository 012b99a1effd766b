"""The client and the command line work without the packages of the server."""

import subprocess
import sys

import pytest

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


BLOCKED = f"import sys\nsys.modules.update(dict.fromkeys({SERVER_ONLY!r}))\n"  # importing what is None fails


def run_without_server(code: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", BLOCKED + code], capture_output=True, text=True, check=False)


@pytest.mark.real
def test_the_client_needs_nothing_of_the_server() -> None:
    done = run_without_server("import stickslip_services.client, stickslip_services.client.pulling")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.real
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
