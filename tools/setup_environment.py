"""Make one of the project's environments, and show how far that is: `make setup` calls it.

    python3.11 tools/setup_environment.py runtime | development | blender

Only the standard library is imported: nothing is installed yet. `uv` installs the packages if it is
on the path, and pip otherwise, or where uv fails. PyTorch is always installed by pip, and first:
pip's configuration says from which index, and so which build (the README explains the choice). uv
gets the indexes of that configuration, which it does not read by itself.
"""

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
MEASUREMENTS = Path(__file__).with_name("setup_measurements.json")
"""Packages, minutes and gigabytes of each environment, as `make release-check` measured them."""

LINE_SECONDS = 15.0
"""A log file gets a line of progress this often [s]; a terminal sees every package."""

TRUSTED_FRACTION = 0.25
"""From this fraction of the packages on, the time left follows from the time that has passed."""

DISTURBING = ("PYTHONPATH", "PYTHONHOME", "PIP_USER", "PIP_TARGET", "PIP_PREFIX")
"""Variables that let packages of another place count as installed, or install to another place."""

UV_VARIABLES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE",
}
"""The variable of uv for each setting of pip that says where packages come from."""

ERROR_LINES = 25
"""The last lines of pip's output that are printed if it fails."""


@dataclass(frozen=True)
class Environment:
    """An environment: its folder, the files that say what belongs into it, and what it is for."""

    folder: str
    requirements: str
    constraints: str
    purpose: str
    first: tuple[str, ...] = ()
    """Requirements that pip installs before all others."""


ENVIRONMENTS = {
    "runtime": Environment(
        ".venv",
        "requirements.txt",
        "constraints.txt",
        "the service, the simulator and the training package",
        # An editable core finds nanobind and Eigen at the same places each time that it is built.
        first=("nanobind", "cmeel-eigen", "torch"),
    ),
    "development": Environment(
        ".venv",
        "requirements-dev.txt",
        "constraints.txt",
        "tests, documentation and checks",
    ),
    "blender": Environment(
        ".venv-blender",
        "requirements-blender.txt",
        "constraints-blender.txt",
        "the renderer: Blender needs another NumPy",
    ),
}


class Expectation(NamedTuple):
    """How many packages an environment has, and how long its set-up took where it was measured."""

    packages: int
    minutes: float


class Progress:
    """Prints how many packages have been collected, and about how many minutes are left."""

    def __init__(self, name: str, expectation: Expectation) -> None:
        self._name = name
        self._expectation = expectation
        self._started = time.monotonic()
        self._printed = 0.0
        self._collected = 0

    def count_package(self) -> None:
        """Count one more package, and print a line if the last one is old enough."""
        self._collected += 1
        now = time.monotonic()
        if sys.stdout.isatty() or now - self._printed > LINE_SECONDS:
            self._printed = now
            self._print(f"{self._collected} of {self._expectation.packages} packages")

    def start_installing(self) -> None:
        """Say that the packages are being unpacked, which takes about as long as collecting."""
        self._print("unpacking")

    def finish(self) -> None:
        """Say how long it took."""
        seconds = time.monotonic() - self._started
        end = "\n" if sys.stdout.isatty() else ""
        print(f"{end}  {self._name}: done after {seconds / 60:.1f} min", flush=True)

    def _print(self, state: str) -> None:
        minutes = self._minutes_left()
        left = "less than a minute left" if minutes < 1 else f"about {minutes:.0f} min left"
        line = f"  {self._name}: {state}, {left}"
        if sys.stdout.isatty():
            print(f"\r{line:<78}", end="", flush=True)
        else:
            print(line, flush=True)

    def _minutes_left(self) -> float:
        """Return the minutes left: as measured elsewhere at first, by this machine's pace later."""
        # pip collects for the first half of the time, and unpacks in the second half.
        fraction = 0.5 * min(1.0, self._collected / self._expectation.packages)
        passed = (time.monotonic() - self._started) / 60
        if fraction < 0.5 * TRUSTED_FRACTION:
            return max(0.0, self._expectation.minutes - passed)
        return passed * (1 - fraction) / fraction


def expectation_of(name: str) -> Expectation:
    """Return the measured size of an environment."""
    record = json.loads(MEASUREMENTS.read_text(encoding="utf-8"))["environments"][name]
    return Expectation(record["packages"], record["minutes"])


def pip_command(environment: Environment) -> list[str]:
    """Return the command of pip in an environment, up to what it installs."""
    python = ROOT / environment.folder / "bin" / "python"
    options = ["--disable-pip-version-check", "--progress-bar", "off"]
    return [str(python), "-m", "pip", "install", *options]


def run_logged(command: list[str], log: Path) -> Iterator[str]:
    """Run a command, and yield the lines that it prints; end the program if it fails."""
    with log.open("a", encoding="utf-8") as file:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=clean_environment(),
        )
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            file.write(line)
            lines.append(line)
            yield line
        if process.wait() != 0:
            print("", *lines[-ERROR_LINES:], sep="\n", file=sys.stderr)
            sys.exit(f"pip failed (above, and in {log}): {' '.join(command)}")


def install_with_pip(arguments: list[str], environment: Environment, progress: Progress) -> None:
    """Install requirements with pip, and show the packages as they are collected."""
    log = ROOT / environment.folder / "setup.log"
    for line in run_logged([*pip_command(environment), *arguments], log):
        if line.startswith("Collecting "):
            progress.count_package()
        elif line.startswith("Installing collected packages"):
            progress.start_installing()


def clean_environment() -> dict[str, str]:
    """Return the variables of this process without those that disturb an installation."""
    return {name: value for name, value in os.environ.items() if name not in DISTURBING}


def pip_settings(listing: str) -> dict[str, str]:
    """Return the settings that `pip config list` prints, without their sections.

    Lines are `global.index-url='URL'`. Variables, of the section `:env:`, come before files.
    """
    settings: dict[str, str] = {}
    for line in sorted(listing.splitlines(), key=lambda line: line.startswith(":env:")):
        name, separator, value = line.partition("=")
        if separator:
            settings[name.rpartition(".")[2]] = ast.literal_eval(value)
    return settings


def uv_variables(settings: dict[str, str]) -> dict[str, str]:
    """Return the variables that let uv find packages where pip finds them."""
    variables = {
        UV_VARIABLES[name]: " ".join(value.split())
        for name, value in settings.items()
        if name in UV_VARIABLES
    }
    # pip takes the best version of all indexes; uv takes the first index that has the package.
    if "UV_INDEX" in variables:
        variables["UV_INDEX_STRATEGY"] = "unsafe-best-match"
    return variables


def install_with_uv(uv: str, arguments: list[str], environment: Environment) -> bool:
    """Install requirements with uv, which shows its own progress; return whether it could."""
    python = str(ROOT / environment.folder / "bin" / "python")
    listing = subprocess.run(
        [python, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False
    )
    # What is set for uv itself comes first.
    variables = uv_variables(pip_settings(listing.stdout)) | clean_environment()
    command = [uv, "pip", "install", "--python", python, *arguments]
    return subprocess.run(command, cwd=ROOT, env=variables, check=False).returncode == 0


def make_environment(name: str) -> None:
    """Make an environment, or bring it up to date."""
    environment = ENVIRONMENTS[name]
    folder = ROOT / environment.folder
    expectation = expectation_of(name)
    print(
        f"{environment.folder}: {environment.purpose} "
        f"({expectation.packages} packages, about {max(1, round(expectation.minutes))} min)",
        flush=True,
    )
    # pip comes last: without it, an earlier set-up was interrupted.
    if not (folder / "bin" / "pip").exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
    progress = Progress(name, expectation)
    versions = ["--constraint", environment.constraints]
    for requirement in environment.first:
        install_with_pip([requirement, *versions], environment, progress)
    requirements = ["--requirement", environment.requirements, *versions]
    uv = shutil.which("uv")
    is_done = uv is not None and install_with_uv(uv, requirements, environment)
    if not is_done:
        if uv is not None:
            print("  uv failed (above), so pip installs the packages", flush=True)
        install_with_pip(requirements, environment, progress)
    progress.finish()


def main() -> int:
    """Make the environments that the command line names."""
    parser = argparse.ArgumentParser(description="Make an environment of the project.")
    parser.add_argument("environments", nargs="+", choices=ENVIRONMENTS)
    for name in parser.parse_args().environments:
        try:
            make_environment(name)
        except subprocess.CalledProcessError as error:
            sys.exit(f"{error.cmd[0]} failed with exit status {error.returncode}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
