"""Set-up works on any machine: pins that every index has, and commands that work as written."""

import importlib.util
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.version import Version
from stickslip_schemas.installation import FOLDERS, install_command

ROOT = Path(__file__).parents[1]
CONSTRAINTS = sorted(ROOT.glob("constraints*.txt"))
MEASUREMENTS = json.loads((ROOT / "tools" / "setup_measurements.json").read_text())
TEXTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted(ROOT.glob("*/README.md")),
    *sorted(ROOT.glob("deploy/**/*.md")),
]
SOURCES = [
    path
    for folder in ("schemas", "measure", "services", "sim_core", "training", "workers")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if "tests" not in path.parts and "build" not in path.parts
]
COMMAND = re.compile(
    r"pip install ((?:'[^']+'|\./[^\s`'\"]+|[a-z][\w.-]*|-e)(?:[ \n](?=[.'a-z-])|))+"
)


def pins(path: Path) -> list[Requirement]:
    """Return the requirements of a constraints file."""
    lines = path.read_text().splitlines()
    return [Requirement(line) for line in lines if line.strip() and not line.startswith("#")]


def commands(text: str) -> list[list[str]]:
    """Return what each `pip install` of a text installs."""
    installs = []
    for match in COMMAND.finditer(text):
        words = match.group().removeprefix("pip install ").split()
        installs.append([word.strip("'") for word in words])
    return installs


@pytest.mark.parametrize("path", CONSTRAINTS, ids=lambda path: path.name)
def test_no_pin_has_a_local_version(path: Path) -> None:
    """A version such as 2.13.0+cpu is on no public index, and pip then finds nothing at all."""
    assert len(pins(path)) > 20
    for requirement in pins(path):
        (specifier,) = requirement.specifier
        assert specifier.operator == "==", requirement
        assert Version(specifier.version).local is None, requirement


def test_the_script_that_pins_drops_local_versions(tmp_path: Path) -> None:
    script = (ROOT / "tools" / "update_constraints.sh").read_text()
    (program,) = re.findall(r"sed '(s/\+[^']*)'", script)
    lines = "numpy==2.4.6\ntorch==2.13.0+cpu\n"
    done = subprocess.run(["sed", program], input=lines, capture_output=True, text=True, check=True)
    assert done.stdout == "numpy==2.4.6\ntorch==2.13.0\n"


def test_the_demo_installs_no_tool_of_tests_or_documentation() -> None:
    runtime = (ROOT / "requirements.txt").read_text()
    development = (ROOT / "requirements-dev.txt").read_text()
    for tool in ("pytest", "sphinx", "mypy", "ruff", "matplotlib", "playwright", "hypothesis"):
        assert not re.search(rf"^{tool}", runtime, re.M)
    assert re.search(r"^-e \./testing", development, re.M)


@pytest.mark.parametrize("path", [*TEXTS, *SOURCES], ids=lambda path: str(path.relative_to(ROOT)))
def test_what_pip_is_told_to_install_can_be_installed(path: Path) -> None:
    """Our distributions are on no index: they are installed from folders, with what they need."""
    packages = {*FOLDERS, "stickslip-sim-core", "stickslip-workers"}
    for targets in commands(path.read_text()):
        folders = [target.partition("[")[0] for target in targets if target.startswith("./")]
        names = [target for target in targets if not target.startswith(("./", "-"))]
        assert not {name.partition("[")[0] for name in names} & packages, targets
        for folder in folders:
            project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
            for text in project["dependencies"]:
                dependency = Requirement(text).name
                if dependency in packages:
                    assert folder_of(dependency) in folders, (targets, dependency)
        for target in targets:
            if target.startswith("./") and "[" in target:
                folder, _, extras = target.rstrip("]").partition("[")
                project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
                assert set(extras.split(",")) <= set(project["optional-dependencies"]), target


def folder_of(distribution: str) -> str:
    """Return the folder of one of our distributions, as commands name it."""
    return FOLDERS[distribution][-1] if distribution in FOLDERS else "./sim_core"


@pytest.mark.parametrize("distribution", FOLDERS)
def test_commands_of_messages_name_folders_that_depend_on_each_other(distribution: str) -> None:
    command = install_command(distribution)
    assert commands(command) == [list(FOLDERS[distribution])]
    name = tomllib.loads((ROOT / FOLDERS[distribution][-1] / "pyproject.toml").read_text())
    assert name["project"]["name"] == distribution


def test_commands_of_messages_quote_what_a_shell_would_expand() -> None:
    command = install_command("stickslip", "server", "postgresql")
    assert command == "pip install ./schemas './services[server,postgresql]'"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("distribution", "extras"),
    [
        ("stickslip-schemas", ("s3",)),
        ("stickslip", ("server", "postgresql")),
        ("stickslip-training", ("export",)),
    ],
)
def test_pip_takes_the_commands_of_messages(distribution: str, extras: tuple[str, ...]) -> None:
    words = [word.strip("'") for word in install_command(distribution, *extras).split()]
    command = [sys.executable, "-m", *words, "--dry-run", "--quiet", "--constraint"]
    done = subprocess.run(
        [*command, str(ROOT / "constraints.txt")], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def tool_named(name: str) -> ModuleType:
    """Return a program of tools/ as a module."""
    path = ROOT / "tools" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    # The programs import each other, from the folder of the one that is run.
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    spec.loader.exec_module(module)
    return module


def test_uv_looks_where_pip_looks() -> None:
    """uv reads no file of pip, so a company's index must be handed over."""
    tool = tool_named("setup_environment")
    listing = (
        ":env:.find-links='/srv/wheels'\n"
        "global.index-url='https://pypi.example.org/simple'\n"
        "global.extra-index-url='\\nhttps://one.example.org\\nhttps://two.example.org'\n"
        "global.find-links='/other'\n"
        "global.timeout='60'\n"
    )
    assert tool.uv_variables(tool.pip_settings(listing)) == {
        "UV_DEFAULT_INDEX": "https://pypi.example.org/simple",
        "UV_INDEX": "https://one.example.org https://two.example.org",
        "UV_FIND_LINKS": "/srv/wheels",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
    }
    assert tool.uv_variables({}) == {}


def test_packages_of_other_places_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "/opt/ros/lib")
    monkeypatch.setenv("PIP_USER", "1")
    monkeypatch.setenv("STICKSLIP_OTHER", "stays")
    environment = tool_named("setup_environment").clean_environment()
    assert not {"PYTHONPATH", "PIP_USER"} & environment.keys()
    assert environment["STICKSLIP_OTHER"] == "stays"


def test_the_pins_are_looked_up_on_the_index_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder of wheels of this machine, from any place of pip's settings, hides no pin."""
    configuration = tmp_path / "pip.conf"
    configuration.write_text(
        "[global]\nindex-url = https://index.test/simple\n"
        f"find-links = {tmp_path}\nextra-index-url = file://{tmp_path}\n"
    )
    monkeypatch.setenv("PIP_CONFIG_FILE", str(configuration))
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", f"file://{tmp_path}")
    environment = tool_named("release_check").public_environment(sys.executable)
    listing = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert str(tmp_path) not in listing
    assert "https://index.test/simple" in listing


def test_pins_are_resolved_with_all_that_a_folder_has() -> None:
    """Tools of development need our distributions, which are no release on the index."""
    requirements_of = tool_named("release_check").requirements_of
    assert requirements_of("runtime") == ["requirements.txt"]
    assert requirements_of("development") == ["requirements.txt", "requirements-dev.txt"]
    assert requirements_of("blender") == ["requirements-blender.txt"]


def test_cpu_time_of_processes_without_a_parent_counts(tmp_path: Path) -> None:
    """Ray's processes outlive the one that starts them, and nobody waits for them."""
    work = (
        "import pathlib, time\n"
        "while time.process_time() < 1.5: pass\n"
        "time.sleep(0.5)\n"
        "pathlib.Path('done').touch()\n"
    )
    launcher = (
        "import subprocess, sys, time\n"
        f"subprocess.Popen([sys.executable, '-c', {work!r}], start_new_session=True)\n"
        "time.sleep(1)\n"
    )
    # The shell stays until the orphan has ended.
    command = f'{sys.executable} -c "$0"; while [ ! -e done ]; do sleep 0.1; done'
    measured = tool_named("release_check").run_measured(["sh", "-c", command, launcher], tmp_path)
    assert 1.4 < measured.cpu_seconds < 6.0


def test_the_readme_has_the_measured_minutes_and_gigabytes() -> None:
    text = " ".join((ROOT / "README.md").read_text().split())
    environments = MEASUREMENTS["environments"]
    runtime = environments["runtime"]["gigabytes"] + environments["blender"]["gigabytes"]
    with_tests = runtime + environments["development"]["gigabytes"]
    assert f"{runtime:.1f} GB of disk" in text
    assert f"{with_tests:.1f} GB with the tools of the tests" in text
    minutes = MEASUREMENTS["minutes"]
    for command, setup, run in (("demo", "setup", "demo"), ("test", "setup-dev", "test")):
        unit = "minute" if minutes[setup] == 1 else "minutes"
        assert f"make {command} # {minutes[setup]} {unit} to set up, {minutes[run]} to run" in text
