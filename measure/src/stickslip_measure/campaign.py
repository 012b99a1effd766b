"""Measures one simulator: every experiment at three resolutions, each result a file of its own.

A result, a **cell**, is written when it is there, so a campaign that was interrupted goes on where
it stopped. A cell is measured again if the adapter, a module that it imports from outside of
site-packages, the version of the simulator or the experiments have changed.
"""

import hashlib
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from stickslip_measure import experiments
from stickslip_measure.contract import SETTINGS, Floats
from stickslip_measure.convergence import Convergence, converged
from stickslip_measure.laboratory import Experiment, Laboratory
from stickslip_measure.process import (
    PATIENCE,
    AdapterError,
    Description,
    HangError,
    Program,
    SetupError,
    SlowError,
    describe,
)

MEASURED = "measured"
NOT_RUN = "not run"
NOT_SUPPORTED = "not supported"

OBSTACLES = {
    SlowError.state: "a coarser mesh was not finished",
    HangError.state: "a coarser mesh hangs",
}
"""States of a cell after which finer resolutions are not run, and why."""

IMPATIENCE = 0.1
"""Share of the time limit that a step may take after another cell of the row has hung.

A simulator that hangs in one scene often hangs in all, and each would take the whole limit.
"""

LOG = "adapter.log"
"""File for the output of an adapter's import."""

Retry = Literal["missing", "all"]

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
    """Digest of interpreter, version, row and experiments."""

    sources: dict[str, str] = field(default_factory=dict)
    """Digests of the adapter and of what it imports from outside of site-packages, by path."""

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

    retry: Retry | None = None
    """Cells that are measured again: those without a value, or all. None measures none again."""


@dataclass
class _Row:
    """A row that is measured."""

    request: Request
    description: Description
    setting: str
    name: str
    softer: float = 1.0
    """Factor on the bending stiffness."""

    patience: float = PATIENCE
    """Share of the time limit that a step may take."""


Tell = Callable[[Cell, bool], None]
"""Takes a cell, and whether it is of an earlier run."""


def measure(request: Request, tell: Tell) -> Description:
    """Measure a simulator; `tell` gets each cell when it is there.

    Raises:
        SetupError: The adapter cannot be imported, or has none of the rows.
        AdapterError: Its process fails before any scene.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    log = request.out / LOG
    description = describe(request.program, log, request.seconds)
    # A simulator may have one row only.
    settings = [setting for setting in request.settings if setting in description.settings]
    if not settings:
        raise SetupError(
            f"--setting: must be a row of the adapter's `settings` "
            f"({', '.join(description.settings)}), got {', '.join(request.settings)}; add it "
            "there, or leave --setting out"
        )
    folder = request.out / description.name
    folder.mkdir(exist_ok=True)
    facts = {**asdict(description), "capabilities": sorted(description.capabilities)}
    # Each cell has its own.
    del facts["sources"]
    (folder / "simulator.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    for setting in settings:
        for cell, is_recorded in _cells_of(_Row(request, description, setting, setting)):
            tell(cell, is_recorded)
    return description


def _cells_of(row: _Row) -> Iterator[tuple[Cell, bool]]:
    # A fault that the checks find explains values of the experiments.
    for name in (*experiments.CHECKS, *row.request.names):
        yield from _experiment(row, experiments.experiment_named(name))
    # A simulator with another bending model may still bend right, up to a factor.
    stiffness = _stiffness(row)
    if stiffness is None or abs(stiffness - 1.0) < FACTOR:
        return
    calibrated = replace(row, name=f"{row.setting}, {CALIBRATED}", softer=1.0 / stiffness)
    for name in experiments.BENDING:
        if name in row.request.names:
            yield from _experiment(calibrated, experiments.experiment_named(name))


def _stiffness(row: _Row) -> float | None:
    """Return the bending stiffness of the cantilever at its middle resolution, over D."""
    cantilever = experiments.EXPERIMENTS["cantilever"]
    path = _path(row, cantilever, cantilever.middle)
    if cantilever.name not in row.request.names or not path.exists():
        return None
    return read_cell(path).value


def _experiment(row: _Row, experiment: Experiment) -> Iterator[tuple[Cell, bool]]:
    key = _key(row, experiment)
    obstacle = ""
    for cells in experiment.cells:
        path = _path(row, experiment, cells)
        cell = _recorded(path, key, row.request.retry)
        is_recorded = cell is not None
        if cell is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            cell = _cell(row, experiment, cells, path.with_suffix(".log"), key, obstacle)
            _write(path, cell)
        obstacle = OBSTACLES.get(cell.state, obstacle)
        if cell.state == HangError.state and not is_recorded:
            row.patience = IMPATIENCE
        yield cell, is_recorded


def _recorded(path: Path, key: str, retry: Retry | None) -> Cell | None:
    """Return the cell of an earlier run, or None if it is measured now."""
    if not path.exists() or retry == "all":
        return None
    cell = read_cell(path)
    if cell.key != key or not _is_current(cell.sources):
        return None
    return None if retry == "missing" and cell.value is None else cell


def _cell(
    row: _Row, experiment: Experiment, cells: int, log: Path, key: str, obstacle: str
) -> Cell:
    """Measure a cell. Whatever goes wrong in the adapter is its reason.

    `obstacle` says why a coarser resolution has ended early, so that this one is not run.
    """
    description = row.description
    conditions = conditions_of(row.request)
    blank = Cell(
        description.name,
        description.version,
        row.name,
        experiment.name,
        cells,
        NOT_RUN,
        obstacle,
        None,
        None,
        0.0,
        key,
        sources=dict(description.sources),
        conditions=conditions,
    )
    missing = sorted(experiment.needs - description.capabilities)
    # Who has rods only has no cloth, which all other experiments need.
    if description.capabilities == {"rods"} and "rods" not in experiment.needs:
        missing = ["cloth"]
    if missing:
        return replace(blank, state=NOT_SUPPORTED, reason=f"needs {', '.join(missing)}")
    if obstacle:
        return blank
    request = row.request
    laboratory = Laboratory(
        request.program,
        description,
        row.setting,
        log,
        request.seconds,
        request.budget,
        row.softer,
        row.patience,
    )
    return _measured(blank, experiment, laboratory)


def _measured(blank: Cell, experiment: Experiment, laboratory: Laboratory) -> Cell:
    """Return a cell with its result."""
    with laboratory:
        try:
            reading = experiment.measure(laboratory, blank.cells)
        except AdapterError as error:
            result = replace(blank, state=error.state, reason=str(error))
        else:
            x, measured, reference = (
                _thinned(curve) for curve in (reading.x, reading.measured, reading.reference)
            )
            result = replace(
                blank,
                state=MEASURED,
                reason="",
                value=reading.value,
                expected=reading.expected,
                details=dict(reading.details),
                x=x,
                measured=measured,
                reference=reference,
            )
    return replace(result, cpu=laboratory.cpu, sources=laboratory.sources)


def _thinned(curve: Floats) -> list[float]:
    """Return a curve as a cell keeps it: a picture needs fewer points than a scene has steps."""
    every = max(1, len(curve) // POINTS)
    # The last point is often the value.
    places = sorted({*range(0, len(curve), every), len(curve) - 1})
    return [float(f"{curve[place]:.{DIGITS}g}") for place in places]


def conditions_of(request: Request) -> dict[str, str | float]:
    """Return when and where a cell is measured, and its limit of CPU time [s]."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "load": round(os.getloadavg()[0], 1),
        "budget": request.budget,
    }


def _path(row: _Row, experiment: Experiment, cells: int) -> Path:
    folder = row.request.out / row.description.name / row.name
    return folder / f"{experiment.name}-{cells}.json"


def _key(row: _Row, experiment: Experiment) -> str:
    """Return a digest of what decides a cell besides its sources."""
    digest = hashlib.sha256()
    # A changed experiment changes the meaning of its value. Each stands in one module.
    source = Path(sys.modules[experiment.measure.__module__].__file__ or "")
    for path in (Path(__file__).with_name("laboratory.py"), source):
        digest.update(path.read_bytes())
    facts = f"{row.request.program.python} {row.description.version} {row.setting} {row.softer!r}"
    digest.update(facts.encode())
    return digest.hexdigest()


def _is_current(sources: Mapping[str, str]) -> bool:
    """Return whether files have their digests. A cell without sources is of an older version."""
    if not sources:
        return False
    return all(_digest(Path(path)) == digest for path, digest in sources.items())


def _digest(path: Path) -> str | None:
    """Return the digest of a file, as host.py makes it, or None if it is gone."""
    if not path.is_file():
        return None
    return hashlib.sha256(path.read_bytes()).hexdigest()


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
        raise ValueError(f"{path} is no result: delete it and measure again ({error})") from error


def read_cells(out: Path) -> list[Cell]:
    """Return all cells of a folder: every simulator, row and experiment."""
    return [read_cell(path) for path in sorted(out.glob("*/*/*-*.json"))]


def convergence(cells: Sequence[Cell]) -> Convergence:
    """Return the findings of the resolutions of an experiment on one row."""
    ordered = sorted(cells, key=lambda cell: cell.cells)
    expected = next((cell.expected for cell in ordered if cell.expected is not None), math.nan)
    return converged([cell.cells for cell in ordered], [cell.value for cell in ordered], expected)
