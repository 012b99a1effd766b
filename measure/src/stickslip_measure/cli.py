"""The command `stickslip-measure`, which `stickslip measure` runs too."""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

from stickslip_measure import __version__, experiments
from stickslip_measure.campaign import LOG, MEASURED, Cell, Request, Retry, measure, read_cells
from stickslip_measure.contract import SETTINGS
from stickslip_measure.diagnosis import findings
from stickslip_measure.process import AdapterError, CrashError, Program, SetupError, StepError

ADAPTERS = Path(__file__).parent / "adapters"

PROGRAM_VARIABLE = "STICKSLIP_MEASURE_PROGRAM"
"""Variable of the environment with the name by which the user has called the command."""

RECORDED = "  [from an earlier run]"
"""End of the line of a result that was not measured now."""

LOGGED = {SetupError.state, StepError.state, CrashError.state}
"""States that the output of the process explains."""


def adapter_names() -> list[str]:
    """Return the names of the adapters that come with the package."""
    return sorted(path.stem for path in ADAPTERS.glob("*.py") if not path.stem.startswith("_"))


def adapter_path(text: str) -> Path:
    """Return the file of an adapter: one of the package, or the user's.

    Raises:
        argparse.ArgumentTypeError: There is none.
    """
    if text in adapter_names():
        return ADAPTERS / f"{text}.py"
    path = Path(text)
    if path.is_file():
        return path
    # The name of an adapter that is misspelt is no path.
    if path.suffix == ".py" or len(path.parts) > 1:
        raise argparse.ArgumentTypeError(f"the file {text!r} does not exist")
    raise argparse.ArgumentTypeError(
        f"must be a Python file or one of {', '.join(adapter_names())}, got {text!r}"
    )


def positive_seconds(text: str) -> float:
    """Return a time limit [s].

    Raises:
        argparse.ArgumentTypeError: It is no positive number.
    """
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0.0 < seconds < 1e6:
        raise argparse.ArgumentTypeError(f"must be above 0 and below 1e6 s, got {text!r}")
    return seconds


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    command = argparse.ArgumentParser(
        prog=os.environ.get(PROGRAM_VARIABLE, "stickslip-measure"),
        description="Measure the friction and bending of a simulator against closed forms, and "
        "write a page. Results of an earlier run are kept, unless the adapter, what it imports "
        "from outside of site-packages, or the simulator's version has changed. The exit status "
        "is 1 if no requested experiment has a value.",
    )
    command.add_argument(
        "--simulator",
        type=adapter_path,
        metavar="NAME|ADAPTER.py",
        help=f"what to measure: {', '.join(adapter_names())}, or the file of an adapter; without "
        "it, only the page is written from the results in --out",
    )
    command.add_argument(
        "--python",
        default=sys.executable,
        metavar="FILE",
        help="interpreter of the simulator's environment (this one)",
    )
    command.add_argument(
        "--experiment",
        action="append",
        choices=list(experiments.EXPERIMENTS),
        metavar="NAME",
        help=f"may be given several times (all): {', '.join(experiments.EXPERIMENTS)}",
    )
    command.add_argument(
        "--setting", action="append", choices=SETTINGS, help="may be given twice (both)"
    )
    command.add_argument("--out", type=Path, default=Path("yardstick"), help="folder (yardstick)")
    command.add_argument(
        "--timeout", type=positive_seconds, default=600.0, help="limit of a scene in s (600)"
    )
    command.add_argument(
        "--budget",
        type=positive_seconds,
        default=600.0,
        help="limit of the CPU time of a result in s (600)",
    )
    command.add_argument(
        "--retry",
        nargs="?",
        const="missing",
        choices=get_args(Retry),
        help="measure again: requested results without a value (missing, if only --retry is given) "
        "or all requested ones",
    )
    command.add_argument("--version", action="version", version=__version__)
    return command


def line_of(cell: Cell, *, is_recorded: bool = False) -> str:
    """Return the line that is printed for a cell."""
    experiment = experiments.experiment_named(cell.experiment)
    unit = "elements" if "rods" in experiment.needs else "cells"
    place = f"{cell.row:10} {cell.experiment:18} {cell.cells:3} {unit:8}"
    ending = RECORDED if is_recorded else ""
    if cell.state != MEASURED:
        return f"{place}  {cell.state}: {cell.reason}{ending}"
    value = f"{cell.value:.6g} {experiment.unit}".strip()
    return f"{place}  {value} (expected {cell.expected:.6g})  {cell.cpu:.1f} CPU s{ending}"


@dataclass
class Report:
    """Prints the results of a request, and keeps them."""

    cells: list[Cell] = field(default_factory=list)
    recorded: int = 0
    """Number of results that are of an earlier run."""

    def tell(self, cell: Cell, is_recorded: bool) -> None:
        """Take and print a result."""
        self.cells.append(cell)
        self.recorded += is_recorded
        print_line(line_of(cell, is_recorded=is_recorded))

    @property
    def has_value(self) -> bool:
        """Whether a requested experiment has a value. The checks are none."""
        return any(
            cell.value is not None
            for cell in self.cells
            if cell.experiment not in experiments.CHECKS
        )

    def print_findings(self) -> None:
        """Print the faults that the results show, row by row."""
        for row in sorted({cell.row for cell in self.cells}):
            for finding in findings([cell for cell in self.cells if cell.row == row]):
                print_line(f"{row}: {finding.fault} ({finding.text})")

    def print_notes(self, folder: Path) -> None:
        """Print how to measure earlier results again, and where failures are explained."""
        if self.recorded:
            print_line(
                f"{self.recorded} of {len(self.cells)} results are of an earlier run; "
                "--retry all measures them again"
            )
        if any(cell.state in LOGGED for cell in self.cells):
            print_line(f"Tracebacks and other output: {folder / 'ROW' / 'EXPERIMENT-CELLS.log'}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 1 if no requested experiment has a value."""
    options = parser().parse_args(arguments)
    # Without a simulator nothing is measured: the page shows the existing results.
    if options.simulator is None:
        return print_page(options.out)
    request = Request(
        Program(options.simulator, options.python),
        options.out,
        options.experiment or list(experiments.EXPERIMENTS),
        options.setting or SETTINGS,
        options.timeout,
        options.budget,
        options.retry,
    )
    report = Report()
    try:
        description = measure(request, report.tell)
    except AdapterError as error:
        log = options.out / LOG
        sys.stderr.write(f"{options.simulator}: {error.state}: {error}\n{log} has its output\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(
            f"interrupted: {len(report.cells)} results are in {options.out}; the same command goes "
            f"on, and `--out {options.out}` without --simulator writes the page\n"
        )
        return 130
    report.print_findings()
    report.print_notes(options.out / description.name)
    return print_page(options.out) or int(not report.has_value)


def print_page(out: Path) -> int:
    """Write the page, and print where it is; return 1 if no result is there."""
    if not read_cells(out):
        sys.stderr.write(f"{out}: has no results; name a simulator with --simulator\n")
        return 1
    # Numbers need no matplotlib.
    if find_spec("matplotlib") is None:
        print_line("The page needs matplotlib: pip install ./sim_core './measure[page]'")
        return 0
    from stickslip_measure.page import write_page

    print_line(str(write_page(out)))
    return 0


def print_line(text: str) -> None:
    """Print a line at once: the next result may take minutes."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
