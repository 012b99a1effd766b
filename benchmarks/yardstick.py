"""Friction and bending of five simulators: the record, the table and the page of docs/yardstick.md.

python benchmarks/yardstick.py [--gather FOLDER] [--picture]

`--gather` takes the cells that `stickslip measure` wrote into a folder over into
benchmarks/results/yardstick.json. From this record the table, the findings and the conditions of
docs/yardstick.md and the page docs/figures/yardstick.html are written. `--picture` also makes a
picture of the page's first screen, which needs /usr/bin/chromium.
"""

import argparse
import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stickslip_measure import experiments
from stickslip_measure.campaign import CALIBRATED, NOT_SUPPORTED, Cell, read_cells
from stickslip_measure.diagnosis import findings
from stickslip_measure.laboratory import Experiment
from stickslip_measure.page import (
    bracketed,
    conditions_text,
    page_text,
    read_simulators,
    representative,
    rows_of,
)

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks/results/yardstick.json"
GUIDE = ROOT / "docs/yardstick.md"
PAGE = ROOT / "docs/figures/yardstick.html"
PICTURE = ROOT / "docs/figures/yardstick.png"
CHROMIUM = "/usr/bin/chromium"
SCREEN = (1280, 800)
"""Width and height [px]."""

BEGIN = "<!-- Written by benchmarks/yardstick.py; do not edit. -->"
END = "<!-- End of the written part. -->"

ORDER = (
    "stickslip",
    "mujoco",
    "newton-vbd",
    "newton-style3d",
    "pybullet",
    "pyelastica",
)
"""Simulators from left to right."""

CURVE_POINTS = 40
"""Points of a curve that the record keeps: a picture has 6 inches."""

DIGITS = 6
"""Significant digits of values, which repeat to fewer on another machine."""

Document = dict[str, Any]


def gathered(folder: Path) -> Document:
    """Return the record of a folder of cells."""
    cells = read_cells(folder)
    # Files are sorted by the text of their names, in which 10 comes before 5.
    cells.sort(key=lambda cell: (place_of(cell.simulator), cell.row, order_of(cell), cell.cells))
    return {
        "what": "Twelve experiments with closed forms on five simulators, by their adapters",
        "command": "stickslip measure --simulator NAME --python ENV/bin/python --budget S --out "
        "FOLDER; python benchmarks/yardstick.py --gather FOLDER",
        "commit": commit(),
        "conditions": "each row states its date, machine, load and limit of CPU time; one thread, "
        "on a shared virtual machine",
        "rows": [row_of(cell) for cell in cells],
        "records": {"simulators": read_simulators(folder), "curves": curves_of(cells)},
    }


def place_of(simulator: str) -> int:
    """Return the place of a simulator from left to right."""
    return ORDER.index(simulator)


def order_of(cell: Cell) -> int:
    """Return the place of an experiment, the checks first."""
    return [*experiments.CHECKS, *experiments.EXPERIMENTS].index(cell.experiment)


def row_of(cell: Cell) -> Document:
    """Return a cell without its curves; what is empty is left out."""
    facts = asdict(cell)
    for name in ("x", "measured", "reference", "key", "sources"):
        del facts[name]
    facts["cpu"] = round(cell.cpu, 1)
    facts["value"] = rounded(cell.value)
    facts["expected"] = rounded(cell.expected)
    facts["details"] = {name: rounded(value) for name, value in cell.details.items()}
    return {name: value for name, value in facts.items() if value not in ("", None, {})}


def rounded(value: float | None) -> float | None:
    """Return a value with the digits of the record."""
    return None if value is None else float(f"{value:.{DIGITS}g}")


def name_of(cell: Cell) -> str:
    """Return the name of a cell in the record."""
    return f"{cell.simulator}, {cell.row}, {cell.experiment}, {cell.cells}"


def curves_of(cells: Sequence[Cell]) -> Document:
    """Return the curves of the cells that the page draws."""
    curves = {}
    for row in rows_of(cells).values():
        for experiment in (*experiments.CHECKS.values(), *experiments.EXPERIMENTS.values()):
            cell = representative(row, experiment)
            if cell is not None and cell.x:
                every = max(1, len(cell.x) // CURVE_POINTS)
                curves[name_of(cell)] = [
                    [float(f"{number:.4g}") for number in curve[::every]]
                    for curve in (cell.x, cell.measured, cell.reference)
                ]
    return curves


def cells_of(record: Document) -> list[Cell]:
    """Return the cells of a record, with the curves that it has."""
    cells = []
    for row in record["rows"]:
        facts = {"reason": "", "value": None, "expected": None, "key": "", **row}
        cell = Cell(**facts)
        x, measured, reference = record["records"]["curves"].get(name_of(cell), ([], [], []))
        cells.append(Cell(**{**facts, "x": x, "measured": measured, "reference": reference}))
    return cells


def commit() -> str:
    """Return the commit of the measurement's code."""
    command = ["git", "rev-parse", "--short=12", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def entry(cells: Sequence[Cell], experiment: Experiment) -> str:
    """Return the value of an experiment, in brackets if it is of a coarser mesh, or its state."""
    cell = representative(cells, experiment)
    if cell is None:
        return "not attempted"
    if cell.state == NOT_SUPPORTED:
        return "–"
    return cell.state if cell.value is None else bracketed(f"{cell.value:.4g}", cell, experiment)


def table(cells: Sequence[Cell]) -> str:
    """Return the table of all experiments and rows, but for calibrated ones."""
    rows = {
        key: chosen for key, chosen in rows_of(cells).items() if not key[1].endswith(CALIBRATED)
    }
    heads = [f"{simulator} {row}".removesuffix(" default") for simulator, row in rows]
    lines = [["experiment", *heads], ["---"] * (1 + len(heads))]
    for experiment in experiments.EXPERIMENTS.values():
        entries = [entry(chosen, experiment) for chosen in rows.values()]
        lines.append([f"`{experiment.name}`", *entries])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def finding_lines(cells: Sequence[Cell]) -> str:
    """Return the faults of all rows as a list."""
    lines = []
    for (simulator, row), chosen in rows_of(cells).items():
        for finding in findings(chosen):
            lines.append(f"* {simulator}, {row}: {finding.fault} ({finding.evidence}).")
    return "\n".join(lines)


def condition_lines(cells: Sequence[Cell], simulators: Sequence[Mapping[str, Any]]) -> str:
    """Return versions and conditions of each simulator as a list."""
    lines = []
    for facts in sorted(simulators, key=lambda each: place_of(each["name"])):
        chosen = [cell for cell in cells if cell.simulator == facts["name"]]
        lines.append(f"* {facts['name']} {facts['version']}. {conditions_text(chosen)}")
    return "\n".join(lines)


def written_part(record: Document) -> str:
    """Return the generated part of docs/yardstick.md."""
    cells = cells_of(record)
    parts = (
        BEGIN,
        table(cells),
        "Faults that the command names:",
        finding_lines(cells),
        "Versions and conditions:",
        condition_lines(cells, record["records"]["simulators"]),
        END,
    )
    return "\n\n".join(parts)


def completed(guide: str, record: Document) -> str:
    """Return docs/yardstick.md with the generated part of a record."""
    before, rest = guide.split(BEGIN)
    return before + written_part(record) + rest.split(END)[1]


def take_picture() -> None:
    """Make a picture of the page's first screen."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=CHROMIUM,
            args=[
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
            ],
            viewport={"width": SCREEN[0], "height": SCREEN[1]},
        )
        page = context.new_page()
        page.goto(PAGE.as_uri())
        page.screenshot(path=PICTURE)
        context.close()


def main() -> None:
    """Gather cells if asked for, and write what follows from the record."""
    parser = argparse.ArgumentParser(description="Friction and bending of five simulators.")
    parser.add_argument("--gather", type=Path, metavar="FOLDER", help="take cells over")
    parser.add_argument("--picture", action="store_true", help="make a picture of the page")
    options = parser.parse_args()
    if options.gather:
        text = json.dumps(gathered(options.gather), ensure_ascii=False, indent=None)
        # A line for each cell, so that a change of one is a change of one line.
        RECORD.write_text(text.replace('{"simulator"', '\n{"simulator"') + "\n")
    record = json.loads(RECORD.read_text())
    GUIDE.write_text(completed(GUIDE.read_text(), record))
    PAGE.write_text(page_text(cells_of(record), record["records"]["simulators"]))
    if options.picture:
        take_picture()


if __name__ == "__main__":
    main()
