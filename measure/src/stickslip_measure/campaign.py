"""Measures one simulator: every experiment at three resolutions, each result a file of its own.

A result, a **cell**, is written when it is there, so a campaign that was interrupted goes on where
it stopped. A cell is measured again if the adapter or the experiments have changed.
"""

import hashlib
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from stickslip_measure import experiments
from stickslip_measure.contract import SETTINGS
from stickslip_measure.convergence import Convergence, converged
from stickslip_measure.laboratory import Experiment, Laboratory
from stickslip_measure.process import AdapterError, Description, Program, SlowError, describe

MEASURED = "measured"
NOT_RUN = "not run"
NOT_SUPPORTED = "not supported"

CALIBRATED = "bending calibrated"
"""End of the name of a row whose bending stiffness was divided by the cantilever's value."""

FACTOR = 0.01
"""A bending stiffness within this share needs no calibration."""

POINTS = 100
"""Points of a picture that a cell keeps: at most twice as many."""

DIGITS = 5
"""Significant digits of these points, which no eye can tell from all of them."""


@dataclass(frozen=True)
class Cell:
    """One experiment on one simulator at one resolution."""

    simulator: str
    version: str
    row: str
    experiment: str
    cells: int
    state: str
    """"measured", or why there is no value: a state of process.py, "not supported", "not run"."""

    reason: str
    value: float | None
    expected: float | None
    cpu: float
    """CPU time of the simulator's process [s]."""

    key: str
    """Digest of adapter, interpreter and experiments."""

    conditions: dict[str, str | float] = field(default_factory=dict)
    """When and where it was measured: `conditions_of`."""

    details: dict[str, float] = field(default_factory=dict)
    x: list[float] = field(default_factory=list)
    measured: list[float] = field(default_factory=list)
    reference: list[float] = field(default_factory=list)

    @property
    def error(self) -> float | None:
        """Value minus the expected value, relative unless that is 0."""
        if self.value is None or self.expected is None:
            return None
        difference = self.value - self.expected
        return difference / self.expected if self.expected else difference


@dataclass(frozen=True)
class Request:
    """A request of a user: experiments and rows of one program, with limits."""

    program: Program
    out: Path
    names: Sequence[str]
    """Names of experiments."""

    settings: Sequence[str] = SETTINGS
    seconds: float = 600.0
    """Time limit of a scene [s]."""

    budget: float = 600.0
    """Limit of the CPU time of a cell [s]."""

    retry: bool = False
    """Whether cells without a value are measured again."""


def measure(request: Request, tell: Callable[[Cell], None]) -> Description:
    """Measure a simulator; `tell` gets each cell when it is there.

    Raises:
        SetupError: The adapter cannot be imported.
        AdapterError: Its process fails before any scene.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    log = request.out / "adapter.log"
    description = describe(request.program, log, request.seconds)
    folder = request.out / description.name
    folder.mkdir(exist_ok=True)
    facts = {**asdict(description), "capabilities": sorted(description.capabilities)}
    (folder / "simulator.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    for setting in request.settings:
        # A simulator may have one row only.
        if setting in description.settings:
            for cell in _row(request, description, setting):
                tell(cell)
    return description


def _row(request: Request, description: Description, setting: str) -> Iterator[Cell]:
    # A fault that the checks find explains values of the experiments.
    chosen = [*experiments.CHECKS, *request.names]
    for name in chosen:
        yield from _experiment(request, description, setting, setting, _named(name), 1.0)
    # A simulator with another bending model may still bend right, up to a factor.
    stiffness = _stiffness(request, description, setting)
    if stiffness is None or abs(stiffness - 1.0) < FACTOR:
        return
    for name in experiments.BENDING:
        if name in request.names:
            row = f"{setting}, {CALIBRATED}"
            yield from _experiment(
                request, description, setting, row, _named(name), 1.0 / stiffness
            )


def _named(name: str) -> Experiment:
    return {**experiments.CHECKS, **experiments.EXPERIMENTS}[name]


def _stiffness(request: Request, description: Description, setting: str) -> float | None:
    """Return the bending stiffness of the cantilever at its default resolution, over D."""
    cantilever = experiments.EXPERIMENTS["cantilever"]
    path = _path(request, description, setting, cantilever, cantilever.default)
    if cantilever.name not in request.names or not path.exists():
        return None
    return read_cell(path).value


def _experiment(
    request: Request,
    description: Description,
    setting: str,
    row: str,
    experiment: Experiment,
    softer: float,
) -> Iterator[Cell]:
    key = _key(request.program, description, setting, softer, experiment)
    slow = False
    for cells in experiment.cells:
        path = _path(request, description, row, experiment, cells)
        if path.exists():
            known = read_cell(path)
            if known.key == key and (known.value is not None or not request.retry):
                slow = slow or known.state == SlowError.state
                yield known
                continue
        log = path.with_suffix(".log")
        path.parent.mkdir(parents=True, exist_ok=True)
        laboratory = Laboratory(
            request.program, description, setting, log, request.seconds, request.budget, softer
        )
        cell = _cell(laboratory, experiment, cells, row, key, slow)
        slow = slow or cell.state == SlowError.state
        cell = replace(cell, conditions=conditions_of(request))
        _write(path, cell)
        yield cell


def _cell(
    laboratory: Laboratory, experiment: Experiment, cells: int, row: str, key: str, slow: bool
) -> Cell:
    """Measure a cell. Whatever goes wrong in the adapter is its reason.

    `slow` says that a coarser resolution took too much time already, so this one is not run.
    """
    description = laboratory.description
    facts = (description.name, description.version, row, experiment.name, cells)
    missing = sorted(experiment.needs - description.capabilities)
    # Who has rods only has no cloth, which all other experiments need.
    if description.capabilities == {"rods"} and "rods" not in experiment.needs:
        missing = ["cloth"]
    if missing:
        reason = f"needs {', '.join(missing)}"
        return Cell(*facts, NOT_SUPPORTED, reason, None, None, 0.0, key)
    if slow:
        reason = "a coarser resolution was not finished"
        return Cell(*facts, NOT_RUN, reason, None, None, 0.0, key)
    with laboratory:
        try:
            reading = experiment.measure(laboratory, cells)
        except AdapterError as error:
            return Cell(*facts, error.state, str(error), None, None, laboratory.cpu, key)
        # A picture needs fewer points than a simulation has steps.
        every = max(1, len(reading.x) // POINTS)
        curves = [
            [float(f"{number:.{DIGITS}g}") for number in curve[::every]]
            for curve in (reading.x, reading.measured, reading.reference)
        ]
        return Cell(
            *facts,
            MEASURED,
            "",
            reading.value,
            reading.expected,
            laboratory.cpu,
            key,
            details=dict(reading.details),
            x=curves[0],
            measured=curves[1],
            reference=curves[2],
        )


def conditions_of(request: Request) -> dict[str, str | float]:
    """Return when and where a cell is measured, and its limit of CPU time [s]."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "load": round(os.getloadavg()[0], 1),
        "budget": request.budget,
    }


def _path(
    request: Request, description: Description, row: str, experiment: Experiment, cells: int
) -> Path:
    return request.out / description.name / row / f"{experiment.name}-{cells}.json"


def _key(
    program: Program, description: Description, setting: str, softer: float, experiment: Experiment
) -> str:
    """Return a digest of all that decides a cell: of the simulator itself, its version."""
    digest = hashlib.sha256()
    # A changed experiment changes the meaning of its value. Each stands in one module.
    source = Path(sys.modules[experiment.measure.__module__].__file__ or "")
    # Adapters of one simulator may share a file, whose name begins with an underscore.
    shared = sorted(program.adapter.parent.glob("_*.py"))
    for path in (program.adapter, *shared, Path(__file__).with_name("laboratory.py"), source):
        digest.update(path.read_bytes())
    digest.update(f"{program.python} {description.version} {setting} {softer!r}".encode())
    return digest.hexdigest()


def _write(path: Path, cell: Cell) -> None:
    # A file that is there is whole, also after a crash.
    part = path.with_suffix(".part")
    part.write_text(json.dumps(asdict(cell)), encoding="utf-8")
    part.replace(path)


def read_cell(path: Path) -> Cell:
    """Read a cell.

    Raises:
        ValueError: The file is no cell.
    """
    try:
        return Cell(**json.loads(path.read_text(encoding="utf-8")))
    except (TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no cell: delete it and measure again ({error})") from error


def read_cells(out: Path) -> list[Cell]:
    """Return all cells of a folder: every simulator, row and experiment."""
    return [read_cell(path) for path in sorted(out.glob("*/*/*-*.json"))]


def convergence(cells: Sequence[Cell]) -> Convergence:
    """Return the findings of the resolutions of an experiment on one row."""
    ordered = sorted(cells, key=lambda cell: cell.cells)
    expected = next((cell.expected for cell in ordered if cell.expected is not None), math.nan)
    return converged([cell.cells for cell in ordered], [cell.value for cell in ordered], expected)
