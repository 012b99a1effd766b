"""What a release needs: one version, licences, complete metadata, and wheels that install into a
bare environment.
"""

import os
import re
import resource
import subprocess
import sys
import tomllib
import venv
from importlib.metadata import distributions
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

ROOT = Path(__file__).parents[1]
VERSION = (ROOT / "VERSION").read_text().strip()
DISTRIBUTIONS = (
    "schemas",
    "sim_core",
    "measure",
    "services",
    "training",
    "workers",
    "workers/blender",
)
PURE = ("schemas", "measure", "services", "training", "workers")
PROJECTS = {
    name: tomllib.loads((ROOT / name / "pyproject.toml").read_text()) for name in DISTRIBUTIONS
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_every_distribution_has_complete_metadata(name: str) -> None:
    project = PROJECTS[name]["project"]
    assert project["dynamic"] == ["version"]
    assert project.keys() >= {
        "description",
        "readme",
        "license",
        "license-files",
        "requires-python",
        "urls",
    }
    assert (ROOT / name / project["readme"]).is_file()
    assert list((ROOT / name).glob("src/*/py.typed")) or list(
        (ROOT / name).glob("python/*/py.typed")
    )


@pytest.mark.parametrize("name", ["sim_core", *PURE])
def test_every_distribution_carries_the_licence(name: str) -> None:
    assert (ROOT / name / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_our_distributions_fit_together(name: str) -> None:
    project = PROJECTS[name]["project"]
    extras = [text for texts in project.get("optional-dependencies", {}).values() for text in texts]
    distributions = [
        Requirement(text)
        for text in (*project["dependencies"], *extras)
        if text.startswith("stickslip-")
    ]
    for requirement in distributions:
        assert requirement.specifier.contains(Version(VERSION)), (
            f"{requirement} does not admit {VERSION}"
        )
        assert str(requirement.specifier), f"{name} must state a range of {requirement.name}"


def test_the_version_is_written_once() -> None:
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == VERSION
    chart = yaml.safe_load((ROOT / "deploy/helm/stickslip/Chart.yaml").read_text())
    assert (chart["version"], chart["appVersion"]) == (VERSION, VERSION)
    values = yaml.safe_load((ROOT / "deploy/helm/stickslip/values.yaml").read_text())
    assert {values[part]["image"].rpartition(":")[2] for part in ("coordinator", "worker")} == {
        VERSION
    }
    for name in DISTRIBUTIONS:
        text = (ROOT / name / "pyproject.toml").read_text()
        assert f'version = "{VERSION}"' not in text


@pytest.mark.parametrize("environment", [".venv", ".venv-blender"])
def test_everything_that_is_installed_admits_the_python_of_debian_12(environment: str) -> None:
    packages = list(distributions(path=[str(ROOT / environment / "lib/python3.11/site-packages")]))
    needs = {
        package.name: package.metadata["Requires-Python"]
        for package in packages
        if package.metadata["Requires-Python"]
    }
    assert len(needs) > 20
    assert {name: need for name, need in needs.items() if "3.11.2" not in SpecifierSet(need)} == {}


PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheels")
    for name in (*PURE, "sim_core"):
        subprocess.run(
            [*PIP, "wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT / name)], check=True
        )
    return folder


def programs_of(wheels: Path, place: Path, *names: str) -> Path:
    """Install packages into a bare environment, and return where its programs are.

    Constraints pin what the index resolves; pip's own configuration says where it is.
    """
    venv.create(place, with_pip=False)
    install = [
        *PIP,
        "--python",
        str(place / "bin" / "python"),
        "install",
        "--find-links",
        str(wheels),
    ]
    subprocess.run(
        [*install, "--constraint", str(ROOT / "constraints.txt"), *names],
        check=True,
        cwd=place.parent,
    )
    return place / "bin"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.xdist_group("wheels")  # which are built once
def test_the_client_is_15_packages_of_60_megabytes(wheels: Path, tmp_path: Path) -> None:
    place = tmp_path / "venv"
    programs = programs_of(wheels, place, "stickslip")
    packages = list(place.glob("lib/python3*/site-packages/*.dist-info"))
    assert len(packages) <= 15, packages
    assert (
        sum(
            file.stat().st_size
            for file in place.rglob("*")
            if file.is_file() and not file.is_symlink()
        )
        < 60e6
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    subprocess.run([str(programs / "stickslip"), "--help"], check=True, stdout=subprocess.DEVNULL)
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 0.3


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.xdist_group("wheels")  # which are built once
def test_wheels_install_into_a_bare_environment(wheels: Path, tmp_path: Path) -> None:
    place = tmp_path / "venv"
    programs = programs_of(wheels, place, "stickslip[arrays,server,train]", "stickslip-sim-core")
    bare = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    for command in ("stickslip", "stickslip-train"):
        done = subprocess.run(
            [str(programs / command), "--help"], capture_output=True, text=True, env=bare
        )
        assert done.returncode == 0, done.stderr
    version = subprocess.run(
        [str(programs / "stickslip"), "--version"], capture_output=True, text=True, env=bare
    )
    assert version.stdout.strip() == f"stickslip {VERSION}"
    code = (
        "import stickslip_sim_core; from stickslip_sim_core import _sim_core; "
        "print(_sim_core.__file__)"
    )
    python = [str(programs / "python"), "-c", code]
    done = subprocess.run(python, capture_output=True, text=True, env=bare, cwd=tmp_path)
    assert done.stdout.startswith(str(place)), done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.xdist_group("wheels")  # which are built once
def test_the_core_alone_is_small_quick_and_needs_numpy(wheels: Path, tmp_path: Path) -> None:
    (wheel,) = wheels.glob("stickslip_sim_core-*.whl")
    assert wheel.stat().st_size <= 15e6
    programs = programs_of(wheels, tmp_path / "venv", "stickslip-sim-core")
    printed = run_alone(programs, tmp_path, "bare_environment.py")
    match = re.search(r"import ([0-9.]+) CPU s", printed)
    assert match is not None, printed
    assert float(match[1]) <= 0.3


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.xdist_group("wheels")  # which are built once
def test_the_notebook_runs_with_the_wheel_and_matplotlib_alone(
    wheels: Path, tmp_path: Path
) -> None:
    programs = programs_of(wheels, tmp_path / "venv", "stickslip-sim-core", "matplotlib")
    notebook = ROOT / "sim_core/notebooks/first_steps.ipynb"
    run_alone(programs, tmp_path, "run_notebook.py", str(notebook))


def run_alone(programs: Path, place: Path, script: str, *arguments: str) -> str:
    """Run a script of the core's tests in a bare environment, and return what it prints."""
    bare = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    command = [str(programs / "python"), str(ROOT / "sim_core/tests" / script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=bare, cwd=place)
    assert done.returncode == 0, done.stderr
    return done.stdout
