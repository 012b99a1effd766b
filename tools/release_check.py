"""Set up a fresh clone as a stranger does, and measure the promises of README.md.

`make release-check` runs it.

    python tools/release_check.py [--python python3.11] [--keep DIR] [--with-tests]

1. pip resolves the pins of all environments with public versions: no folder of wheels helps.
2. `make setup` and `make demo` of a fresh clone end well. Their minutes, CPU seconds, packages and
   gigabytes are written to tools/setup_measurements.json, which README.md must agree with.
3. With `--with-tests`, `make setup-dev` and `make test` are measured, too.
"""

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from setup_environment import ENVIRONMENTS, pip_settings

ROOT = Path(__file__).parents[1]
MEASUREMENTS = ROOT / "tools" / "setup_measurements.json"
DEMO_CPU_SECONDS = 400
"""The demo must not take more CPU time than this after set-up [s]."""


SAMPLE_SECONDS = 0.2
"""Time between two looks at the CPU times of processes [s]."""


@dataclass(frozen=True)
class Measurement:
    """What a command took."""

    minutes: float
    cpu_seconds: float


def public_environment(python: str) -> dict[str, str]:
    """Return the variables with which pip sees its index alone.

    A folder of wheels or a second index, in a variable or in the configuration of the machine, may
    have a build of its own, for example PyTorch for CPUs. It would hide that the index has none.
    """
    command = [python, "-m", "pip", "config", "list"]
    listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    settings = pip_settings(listing)
    hiding = ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL")
    environment = {name: value for name, value in os.environ.items() if name not in hiding}
    environment["PIP_CONFIG_FILE"] = os.devnull
    # Where the index is, and how to trust it, is still that of the machine.
    for setting in ("index-url", "cert"):
        if setting in settings:
            environment["PIP_" + setting.replace("-", "_").upper()] = settings[setting]
    return environment


def requirements_of(name: str) -> list[str]:
    """Return the files whose requirements make an environment.

    A folder may be filled in turns: what the earlier environments installed there is in it, too.
    """
    folder = ENVIRONMENTS[name].folder
    names = list(ENVIRONMENTS)
    until = names[: names.index(name) + 1]
    return [
        ENVIRONMENTS[earlier].requirements
        for earlier in until
        if ENVIRONMENTS[earlier].folder == folder
    ]


def resolve_pins(python: str, name: str) -> list[str]:
    """Let pip resolve an environment with public versions alone, and return the local ones.

    Nothing is installed. Ends the program if pip finds no solution.
    """
    environment = ENVIRONMENTS[name]
    requirements: list[str] = []
    for file in requirements_of(name):
        requirements += ["--requirement", file]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        options = ["--quiet", "--dry-run", "--ignore-installed", "--report", str(report)]
        done = subprocess.run(
            [
                *(python, "-m", "pip", "install", *options),
                *("--constraint", environment.constraints, *requirements),
            ],
            cwd=ROOT,
            env=public_environment(python),
            capture_output=True,
            text=True,
        )
        if done.returncode != 0:
            sys.exit(f"pip cannot resolve {environment.requirements}:\n{done.stderr[-2000:]}")
        packages = json.loads(report.read_text(encoding="utf-8"))["install"]
    print(f"{environment.requirements}: {len(packages)} packages, from the index alone", flush=True)
    versions = {p["metadata"]["name"]: p["metadata"]["version"] for p in packages}
    return [f"{name}=={version}" for name, version in versions.items() if "+" in version]


class CpuMeter(threading.Thread):
    """Adds up the CPU time of a process and of all that descend from it.

    The times of waited-for children are not enough: Ray's processes end without a parent that
    waits for them. What a process does after its last sample is lost.
    """

    def __init__(self, root: int) -> None:
        super().__init__(daemon=True)
        self._known = {root}
        self._seconds: dict[tuple[int, int], float] = {}
        self._is_done = threading.Event()

    def run(self) -> None:
        """Sample until `finish`."""
        while not self._is_done.wait(SAMPLE_SECONDS):
            self.sample()

    def sample(self) -> None:
        """Take the CPU time of each process that is known, and of its children."""
        tick = os.sysconf("SC_CLK_TCK")
        for path in Path("/proc").glob("[0-9]*/stat"):
            # A process may end at any time.
            with contextlib.suppress(OSError):
                # The name of the program, in brackets, may hold blanks.
                fields = path.read_text(encoding="ascii", errors="replace").rpartition(")")[2]
                numbers = [int(number) for number in fields.split()[1:20]]
                process, parent = int(path.parent.name), numbers[0]
                if parent in self._known or process in self._known:
                    self._known.add(process)
                    self._seconds[process, numbers[18]] = (numbers[10] + numbers[11]) / tick

    def finish(self) -> float:
        """Return the CPU time of all processes [s]."""
        self._is_done.set()
        self.join()
        return sum(self._seconds.values())


def run_measured(command: list[str], folder: Path) -> Measurement:
    """Run a command in a folder; end the program if it fails."""
    print("==", *command, flush=True)
    started = time.monotonic()
    with subprocess.Popen(command, cwd=folder) as process:
        meter = CpuMeter(process.pid)
        meter.start()
        status = process.wait()
        cpu_seconds = meter.finish()
    if status != 0:
        raise subprocess.CalledProcessError(status, command)
    return Measurement((time.monotonic() - started) / 60, cpu_seconds)


def count_packages(environment: Path) -> int:
    """Return how many packages an environment has."""
    return len(list(environment.glob("lib/python3*/site-packages/*.dist-info")))


def gigabytes(folder: Path) -> float:
    """Return the size of a folder on the disk [GB]."""
    done = subprocess.run(
        ["du", "-s", "-B1", str(folder)], capture_output=True, text=True, check=True
    )
    return int(done.stdout.split()[0]) / 1e9


def measure(clone: Path, python: str, with_tests: bool) -> dict[str, Any]:
    """Set a clone up, run the demo and, if asked, the tests; return the record."""
    make = ["make", f"PYTHON={python}"]
    setup = run_measured([*make, "setup"], clone)
    demo = run_measured([*make, "demo"], clone)
    if demo.cpu_seconds > DEMO_CPU_SECONDS:
        sys.exit(f"the demo took {demo.cpu_seconds:.0f} CPU s, and may take {DEMO_CPU_SECONDS}")
    runtime = clone / ".venv"
    blender = clone / ".venv-blender"
    # Blender's environment is made after the other: two thirds of the time are the first one's.
    record: dict[str, Any] = {
        "environments": {
            "runtime": {
                "packages": count_packages(runtime),
                "minutes": round(setup.minutes * 2 / 3, 1),
                "gigabytes": round(gigabytes(runtime), 1),
            },
            "blender": {
                "packages": count_packages(blender),
                "minutes": round(setup.minutes / 3, 1),
                "gigabytes": round(gigabytes(blender), 1),
            },
        },
        "minutes": {"setup": round(setup.minutes), "demo": round(demo.minutes)},
        "load": round(os.getloadavg()[2], 1),
        "demo_cpu_seconds": round(demo.cpu_seconds),
    }
    if with_tests:
        development = run_measured([*make, "setup-dev"], clone)
        test = run_measured([*make, "test"], clone)
        before = record["environments"]["runtime"]
        record["environments"]["development"] = {
            "packages": count_packages(runtime) - before["packages"],
            "minutes": round(development.minutes, 1),
            "gigabytes": round(gigabytes(runtime) - before["gigabytes"], 1),
        }
        record["minutes"]["setup-dev"] = round(development.minutes)
        record["minutes"]["test"] = round(test.minutes)
    return record


def merge_records(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return the old record with the numbers that were measured anew."""
    merged = dict(old)
    for name, value in new.items():
        merged[name] = {**old.get(name, {}), **value} if isinstance(value, dict) else value
    return merged


def main() -> int:
    """Check the pins, measure a fresh clone and write the record."""
    parser = argparse.ArgumentParser(description="Measure the set-up of a fresh clone.")
    parser.add_argument(
        "--python", default="python3.11", help="the interpreter of the environments"
    )
    parser.add_argument("--keep", type=Path, help="clone into this empty folder, and keep it")
    parser.add_argument("--with-tests", action="store_true", help="run make test, too")
    options = parser.parse_args()
    for name in ENVIRONMENTS:
        local = resolve_pins(options.python, name)
        if local:
            sys.exit(f"versions that are on no public index: {', '.join(local)}")
    folder = options.keep or Path(tempfile.mkdtemp(prefix="stickslip-release-"))
    try:
        clone = folder / "clone"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        record = measure(clone, options.python, options.with_tests)
    finally:
        if options.keep is None:
            shutil.rmtree(folder)
    old = json.loads(MEASUREMENTS.read_text(encoding="utf-8"))
    MEASUREMENTS.write_text(json.dumps(merge_records(old, record), indent=2) + "\n")
    print(f"wrote {MEASUREMENTS}; tests/test_installation.py compares README.md with it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
