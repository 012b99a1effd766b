"""The command `stickslip-measure`, which `stickslip measure` runs too."""

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from stickslip_measure import __version__, experiments
from stickslip_measure.campaign import MEASURED, Cell, Request, measure, read_cells
from stickslip_measure.contract import SETTINGS
from stickslip_measure.diagnosis import findings
from stickslip_measure.process import AdapterError, Program

ADAPTERS = Path(__file__).parent / "adapters"


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
    if not path.is_file():
        raise argparse.ArgumentTypeError(
            f"must be a Python file or one of {', '.join(adapter_names())}, got {text!r}"
        )
    return path


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
        prog="stickslip-measure",
        description="Measure the friction and bending of a simulator against closed forms, and "
        "write a page. Cells that are there already are not measured again.",
    )
    command.add_argument(
        "--simulator",
        type=adapter_path,
        metavar="NAME|ADAPTER.py",
        help=f"what to measure: {', '.join(adapter_names())}, or the file of an adapter; without "
        "it, only the page is written",
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
        help="limit of the CPU time of a cell in s (600)",
    )
    command.add_argument(
        "--retry", action="store_true", help="measure cells without a value once more"
    )
    command.add_argument("--version", action="version", version=__version__)
    return command


def line_of(cell: Cell) -> str:
    """Return the line that is printed for a cell."""
    place = f"{cell.row:10} {cell.experiment:18} {cell.cells:4}"
    if cell.state != MEASURED:
        return f"{place}  {cell.state}: {cell.reason}"
    return f"{place}  {cell.value:.6g} (expected {cell.expected:.6g})  {cell.cpu:.1f} CPU s"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 1 if the adapter could not be run at all."""
    options = parser().parse_args(arguments)
    # Without a simulator nothing is measured: the page shows the existing cells.
    if options.simulator is not None:
        request = Request(
            Program(options.simulator, options.python),
            options.out,
            options.experiment or list(experiments.EXPERIMENTS),
            options.setting or SETTINGS,
            options.timeout,
            options.budget,
            options.retry,
        )
        try:
            description = measure(request, lambda cell: print_line(line_of(cell)))
        except AdapterError as error:
            sys.stderr.write(f"{options.simulator}: {error.state}: {error}\n")
            return 1
        print_findings(options.out, description.name)
    return print_page(options.out)


def print_page(out: Path) -> int:
    """Write the page, and print where it is; return 1 if no cell is there."""
    if not read_cells(out):
        sys.stderr.write(f"{out}: has no cells; name a simulator with --simulator\n")
        return 1
    # Numbers need no matplotlib.
    if find_spec("matplotlib") is None:
        print_line("The page needs matplotlib: pip install ./sim_core './measure[page]'")
        return 0
    from stickslip_measure.page import write_page

    print_line(str(write_page(out)))
    return 0


def print_findings(out: Path, simulator: str) -> None:
    """Print the faults that the cells of a simulator show, row by row."""
    cells = [cell for cell in read_cells(out) if cell.simulator == simulator]
    for row in sorted({cell.row for cell in cells}):
        for finding in findings([cell for cell in cells if cell.row == row]):
            print_line(f"{row}: {finding.fault} ({finding.evidence})")


def print_line(text: str) -> None:
    """Print a line at once: the next cell may take minutes."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
