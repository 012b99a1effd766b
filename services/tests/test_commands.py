"""The table of commands, of which each is imported when it is called."""

import subprocess
import sys

import pytest
import typer
from stickslip_services.cli.main import _COMMANDS, _Commands, _loaded, app
from typer.testing import CliRunner


def test_help_imports_no_command() -> None:
    check = """
import sys
from stickslip_services.cli import app
try:
    app(["--help"])
except SystemExit:
    print(sorted({"numpy", "pydantic", "httpx", "stickslip_schemas"} & sys.modules.keys()))
"""
    run = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert "audit-log" in run.stdout
    assert run.stdout.strip().splitlines()[-1] == "[]"


@pytest.mark.parametrize("name", _COMMANDS)
def test_the_list_says_what_the_command_says(name: str) -> None:
    group = typer.main.get_group(app)
    assert isinstance(group, _Commands)
    listed = group.get_command(typer.Context(group), name)
    assert listed is not None
    assert listed.help
    assert listed.help.split("\n\n")[0].split() == (_loaded(name).help or "").split("\n\n")[0].split()


def test_a_command_that_does_not_exist() -> None:
    result = CliRunner().invoke(app, ["submitt"])
    assert result.exit_code == 2
    assert "Did you mean 'submit'?" in result.output


def test_a_client_without_the_server_says_what_is_missing() -> None:
    code = "import sys; sys.modules['sqlalchemy'] = None; from stickslip_services.cli import app; app(['keys', 'list'])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "needs the server, and sqlalchemy is not installed" in run.stderr
