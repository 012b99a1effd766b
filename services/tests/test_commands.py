"""The table of commands, of which each is imported when it is called."""

import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from stickslip_services.cli import _COMMANDS, _Commands, _loaded, app, output

SCRIPT = Path(sys.executable).with_name("stickslip")


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
    assert isinstance(app, _Commands)
    listed = app.get_command(click.Context(app), name)
    assert listed is not None
    assert listed.help
    assert (
        listed.help.split("\n\n")[0].split() == (_loaded(name).help or "").split("\n\n")[0].split()
    )


def test_a_command_that_does_not_exist() -> None:
    result = CliRunner().invoke(app, ["submitt"])
    assert result.exit_code == 2
    assert "Did you mean 'submit'?" in result.output


def test_a_client_without_the_server_says_what_is_missing() -> None:
    code = (
        "import sys; sys.modules['sqlalchemy'] = None; "
        "from stickslip_services.cli import app; app(['keys', 'list'])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "needs the server, and sqlalchemy is not installed" in run.stderr


def test_narrow_terminals_show_fewer_columns_and_break_no_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    rows: list[tuple[output.Cell, ...]] = [
        ("ds-0123456789abcdef:v1", "a-long-name", "succeeded"),
        ("ds-1", "b", output.Styled("failed", "red")),
    ]
    output.print_table(("dataset", "name", "state"), rows)
    captured = capsys.readouterr()
    assert [line.split() for line in click.unstyle(captured.out).splitlines()] == [
        ["dataset", "name"],
        ["ds-0123456789abcdef:v1", "a-long-name"],
        ["ds-1", "b"],
    ]
    assert "not shown in 40 columns: state; --json shows all" in " ".join(captured.err.split())
    output.print_table(
        ("slot", "message"),
        [("3", "its centreline leaves the frame by 12 px at the left")],
        sentences=True,
    )
    assert [line.strip() for line in click.unstyle(capsys.readouterr().out).splitlines()] == [
        "slot  message",
        "3     its centreline leaves the frame by",
        "12 px at the left",
    ]


@pytest.mark.parametrize(("shell", "file"), [("bash", ".bashrc"), ("zsh", ".zshrc")])
def test_completion_is_installed_once(shell: str, file: str, tmp_path: Path) -> None:
    for _ in range(2):
        assert (
            CliRunner()
            .invoke(app, ["--install-completion", shell], env={"HOME": str(tmp_path)})
            .exit_code
            == 0
        )
    assert (
        tmp_path / file
    ).read_text() == f'eval "$(_STICKSLIP_COMPLETE={shell}_source stickslip)"\n'


def test_commands_and_options_are_completed() -> None:
    env = os.environ | {
        "_STICKSLIP_COMPLETE": "bash_complete",
        "COMP_CWORD": "2",
        "COMP_WORDS": "stickslip validate --j",
    }
    run = subprocess.run([SCRIPT], capture_output=True, text=True, check=False, env=env)
    assert run.stdout.split() == ["plain,--json"]
