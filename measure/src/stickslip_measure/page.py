"""The page of a campaign: one screen that says who holds and who creeps, and pictures below."""

import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from stickslip_measure import __version__, experiments
from stickslip_measure.campaign import CALIBRATED, MEASURED, Cell, convergence, read_cells
from stickslip_measure.diagnosis import CREEP, findings, row_of
from stickslip_measure.laboratory import Experiment

GOOD = 0.01
"""Largest error of a cell that is marked as good."""

FAIR = 0.05
"""Largest error of a cell that is marked as fair."""

SPOILED = " †"
"""Mark of a value that is wrong because of a fault that is named below the table."""

STYLES = ("-", "--", ":", "-.")
COLOURS = ("#1f6f8b", "#c2571a", "#4a7c2a", "#7b4fa3", "#a8324a", "#6b6b00")

Row = tuple[str, str]
"""Simulator and row of its settings."""


def write_page(out: Path) -> Path:
    """Write OUT/index.html from all cells of a folder, and return its path.

    Raises:
        ValueError: A file of the folder is no cell.
    """
    page = out / "index.html"
    page.write_text(page_text(read_cells(out), read_simulators(out)), encoding="utf-8")
    return page


def page_text(cells: Sequence[Cell], simulators: Sequence[Mapping[str, Any]]) -> str:
    """Return the page.

    Args:
        cells: Cells of all simulators.
        simulators: The description of each simulator, as `simulator.json` has it.
    """
    rows = rows_of(cells)
    return TEMPLATE.substitute(
        version=escape(__version__),
        overview=overview(rows),
        findings="".join(finding_items(rows)),
        experiments="".join(section(experiment, rows) for experiment in chosen(rows)),
        simulators="".join(
            simulator_text(facts, [cell for cell in cells if cell.simulator == facts["name"]])
            for facts in simulators
        ),
    )


def rows_of(cells: Sequence[Cell]) -> dict[Row, list[Cell]]:
    """Return the cells of each row of each simulator."""
    rows: dict[Row, list[Cell]] = {}
    for cell in cells:
        rows.setdefault((cell.simulator, cell.row), []).append(cell)
    return rows


def read_simulators(out: Path) -> list[Mapping[str, Any]]:
    """Return the descriptions of all simulators of a folder."""
    paths = sorted(out.glob("*/simulator.json"))
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


def chosen(rows: Mapping[Row, Sequence[Cell]]) -> Iterator[Experiment]:
    """Yield the checks and experiments that some row has."""
    names = {cell.experiment for cells in rows.values() for cell in cells}
    for experiment in (*experiments.CHECKS.values(), *experiments.EXPERIMENTS.values()):
        if experiment.name in names:
            yield experiment


def representative(cells: Sequence[Cell], experiment: Experiment) -> Cell | None:
    """Return the cell that stands for an experiment: of the middle resolution, if it has a value.

    Otherwise it is the finest of the coarser ones that have a value, or else the coarsest, whose
    reason says more than that of a cell that was not run.
    """
    at_most = sorted(
        (c for c in cells if c.experiment == experiment.name and c.cells <= experiment.middle),
        key=lambda cell: cell.cells,
    )
    measured = [cell for cell in at_most if cell.state == MEASURED]
    return next(iter([*measured[::-1], *at_most]), None)


def bracketed(text: str, cell: Cell, experiment: Experiment) -> str:
    """Return a text in brackets if its cell is coarser than the middle resolution."""
    return text if cell.cells == experiment.middle else f"({text})"


def overview(rows: Mapping[Row, Sequence[Cell]]) -> str:
    """Return the table of the first screen."""
    heads = "".join(
        f'<th><a href="#{name}">{escape(name.replace("-", " "))}</a></th>'
        for name in experiments.EXPERIMENTS
    )
    lines = [f'<tr><th class="who">simulator</th><th>verdict</th>{heads}</tr>']
    for (simulator, row), cells in rows.items():
        entries = "".join(entry(cells, each) for each in experiments.EXPERIMENTS.values())
        simulator_head = f'<th class="who">{escape(simulator)}<small>{escape(row)}</small></th>'
        lines.append(f"<tr>{simulator_head}{verdict(cells)}{entries}</tr>")
    return "\n".join(lines)


def table_entry(name: str, mark: str, content: str, reason: str = "") -> str:
    """Return an entry of the first table; a narrow screen shows the name of its column, too."""
    title = f' title="{escape(reason)}"' if reason else ""
    label = escape(name.replace("-", " "))
    return f'<td class="{mark}" data-column="{label}"{title}>{content}</td>'


def verdict(cells: Sequence[Cell]) -> str:
    """Return whether cloth holds at 90 % of the angle of slip, as an entry of the table."""
    creep = experiments.EXPERIMENTS["creep"]
    cell = representative(cells, creep)
    if cell is None:
        return table_entry("verdict", "none", absent(cells))
    if cell.value is None:
        # Only a simulator that sleeps has been found out: others gave no answer, and did not fail.
        mark, word = ("poor", "sleeps") if cell.state == "sleeps" else ("none", "no answer")
        return table_entry("verdict", mark, word, cell.reason)
    if cell.value < CREEP:
        return table_entry("verdict", "good", bracketed("holds", cell, creep))
    return table_entry("verdict", "poor", bracketed("creeps", cell, creep))


def entry(cells: Sequence[Cell], experiment: Experiment) -> str:
    """Return the error, or the reason why there is none."""
    cell = representative(cells, experiment)
    if cell is None:
        return table_entry(experiment.name, "absent", absent(cells))
    if cell.state != MEASURED:
        return table_entry(experiment.name, "none", escape(cell.state), cell.reason)
    text = bracketed(error_text(cell, experiment), cell, experiment)
    causes = [fault.fault for fault in findings(cells) if experiment.name in fault.spoiled]
    reason = ""
    if causes:
        text += SPOILED
        reason = f"because of this: {', '.join(causes)}"
    return table_entry(experiment.name, grade(cell, experiment), text, reason)


def absent(cells: Sequence[Cell]) -> str:
    """Return the word for an experiment that a row does not have."""
    # Only bending is repeated with a calibrated bending stiffness.
    return "–" if cells[0].row.endswith(CALIBRATED) else "not requested"


def grade(cell: Cell, experiment: Experiment) -> str:
    """Return the mark of an error: good, fair or poor."""
    error = abs(cell.error or 0.0)
    # The error of the creep is a displacement.
    if experiment.unit == "mm":
        return "good" if error < CREEP else "poor"
    if error <= GOOD:
        return "good"
    return "fair" if error <= FAIR else "poor"


def error_text(cell: Cell, experiment: Experiment) -> str:
    """Return an error with its unit."""
    error = cell.error
    if error is None:
        return "–"
    if experiment.unit:
        return f"{error:.2g} {escape(experiment.unit)}"
    # No decimals where the first figure is wrong already.
    return f"{100.0 * error:+.2f} %" if abs(error) < 0.1 else f"{100.0 * error:+.0f} %"


def finding_items(rows: Mapping[Row, Sequence[Cell]]) -> Iterator[str]:
    """Yield the faults of all rows as items of a list."""
    for (simulator, row), cells in rows.items():
        for finding in findings(cells):
            head = escape(f"{simulator}, {row}: {finding.fault}.")
            yield f"<li><strong>{head}</strong> {escape(finding.text)}</li>"


def section(experiment: Experiment, rows: Mapping[Row, Sequence[Cell]]) -> str:
    """Return the section of an experiment: formula, table, picture."""
    lines = []
    for (simulator, row), cells in rows.items():
        measured = row_of(cells).get(experiment.name)
        if measured:
            lines.append(
                f"<tr><th>{escape(simulator)}</th><td>{escape(row)}</td>"
                f"{resolution_entries(experiment, measured)}</tr>"
            )
    heads = "".join(f"<th>{cells} cells</th>" for cells in experiment.cells)
    return SECTION.substitute(
        name=experiment.name,
        title=escape(experiment.title),
        formula=escape(experiment.formula),
        quantity=escape(experiment.quantity),
        heads=heads,
        lines="\n".join(lines),
        picture=picture(experiment, rows),
    )


def resolution_entries(experiment: Experiment, measured: Sequence[Cell]) -> str:
    """Return values, limit, order, error and cost of an experiment as entries of its table."""
    by_cells = {cell.cells: cell for cell in measured}
    entries = []
    for cells in experiment.cells:
        cell = by_cells.get(cells)
        if cell is None:
            entries.append("<td>not requested</td>")
        elif cell.value is None:
            entries.append(f'<td class="reason">{escape(cell.state)}: {escape(cell.reason)}</td>')
        else:
            entries.append(f"<td>{cell.value:.5g}</td>")
    entries.append(limit_entries(measured))
    cell = by_cells.get(experiment.middle)
    entries.append(f"<td>{error_text(cell, experiment) if cell is not None else '–'}</td>")
    entries.append(f"<td>{sum(cell.cpu for cell in measured):.1f}</td>")
    return "".join(entries)


def limit_entries(measured: Sequence[Cell]) -> str:
    """Return limit and order, or why the resolutions show none."""
    trend = convergence(measured)
    if math.isnan(trend.limit):
        # A cell without a value has said why.
        missing = any(cell.value is None for cell in measured)
        return f'<td class="reason" colspan="2">{"–" if missing else escape(trend.reason)}</td>'
    order = number(trend.order) if not trend.reason else escape(trend.reason)
    return f"<td>{number(trend.limit)}</td><td>{order}</td>"


def number(value: float) -> str:
    """Return a number, or a dash for none."""
    return "–" if math.isnan(value) else f"{value:.4g}"


def picture(experiment: Experiment, rows: Mapping[Row, Sequence[Cell]]) -> str:
    """Return the curves of all rows beside the closed form, as SVG."""
    # Text stays text, so that the page can be searched; a fixed salt gives the same file twice.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": experiment.name, "font.size": 9}):
        figure = Figure(figsize=(6.2, 3.0), layout="constrained")
        axes = figure.subplots()
        drawn = 0
        for index, ((simulator, row), cells) in enumerate(rows.items()):
            cell = representative(cells, experiment)
            if cell is None or not cell.x:
                continue
            # All rows have the same closed form, but for the frames of their steps.
            if not drawn:
                axes.plot(cell.x, cell.reference, color="0.6", lw=4, label="closed form")
            style = STYLES[index // len(COLOURS) % len(STYLES)]
            colour = COLOURS[index % len(COLOURS)]
            label = bracketed(f"{simulator}, {row}", cell, experiment)
            marker = "." if len(cell.x) < 30 else ""
            axes.plot(cell.x, cell.measured, style, marker=marker, color=colour, label=label)
            drawn += 1
        if not drawn:
            return "<p>No row has a value.</p>"
        axes.set_xlabel(experiment.axes[0])
        axes.set_ylabel(experiment.axes[1])
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None})
    # The header of a file does not belong into a page.
    text = stream.getvalue()
    svg = text[text.index("<svg") :]
    label = escape(f"{experiment.title}: {experiment.axes[1]} against {experiment.axes[0]}")
    return svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)


def simulator_text(facts: Mapping[str, Any], cells: Sequence[Cell]) -> str:
    """Return the versions of a simulator, what its adapter did, and how it was measured."""
    items = []
    for setting, numbers in facts["settings"].items():
        pairs = ", ".join(f"{name}: {value}" for name, value in numbers.items())
        items.append(f"<li><strong>{escape(setting)}</strong>: {escape(pairs)}</li>")
    return (
        f"<h3>{escape(facts['name'])} {escape(facts['version'])}</h3>"
        f"<p>Python {escape(facts['python'])}, NumPy {escape(facts['numpy'])}. Can: "
        f"{escape(', '.join(facts['capabilities']))}. Clearance {facts['clearance']:g} m, gap "
        f"{facts['gap']:g} m. {escape(conditions_text(cells))}</p><ul>{''.join(items)}</ul>"
    )


def conditions_text(cells: Sequence[Cell]) -> str:
    """Return when and where the cells of a simulator were measured, and with which limit."""
    conditions = [cell.conditions for cell in cells]
    if not all(conditions):
        return ""
    dates = sorted({str(each["date"]) for each in conditions})
    machines = sorted({str(each["machine"]) for each in conditions})
    loads = [float(each["load"]) for each in conditions]
    budgets = sorted({float(each["budget"]) for each in conditions})
    limits = " or ".join(f"{budget:g}" for budget in budgets)
    return (
        f"Measured on {' and '.join(dates)} on {' and '.join(machines)}, at a load of "
        f"{min(loads):g} to {max(loads):g}, with at most {limits} s of CPU time for a result."
    )


SECTION = Template("""
<section id="$name">
<h3>$title</h3>
<p>Closed form: $formula. Value: $quantity.</p>
<div class="wide"><table>
<tr><th>simulator</th><th>row</th>$heads<th>limit</th><th>order</th><th>error</th>
<th>CPU s</th></tr>
$lines
</table></div>
$picture
</section>
""")

TEMPLATE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Yardstick: friction and bending of simulators</title>
<style>
:root { color-scheme: light dark; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 1rem auto; max-width: 1240px;
  padding: 0 1rem; color: #1b1f23; background: #fff; }
h1 { font-size: 1.4rem; margin: 0 0 .3rem; }
table { border-collapse: collapse; font-size: 13px; }
th, td { border: 1px solid #c9ced3; padding: .25rem .4rem; text-align: left; }
.overview { width: 100%; table-layout: fixed; font-size: 12px; line-height: 1.25; }
.overview th, .overview td { text-align: center; padding: .2rem .15rem; }
.overview .who { width: 8.5em; text-align: left; overflow-wrap: anywhere; }
.overview small { display: block; font-weight: normal; }
.wide { overflow-x: auto; }
.good { background: #d5efd8; color: #0d3b16; }
.fair { background: #fbeec2; color: #4d3b00; }
.poor { background: #f8d3cf; color: #5c1008; }
.none, .absent { color: #59636e; }
.reason { max-width: 22rem; }
section { border-top: 1px solid #c9ced3; margin-top: 1.2rem; }
li { overflow-wrap: anywhere; }  /* addresses of sources are long */
svg { background: #fff; max-width: 100%; height: auto; }
a { color: inherit; }
/* On a narrow screen each simulator is a card, and each entry has the name of its column. */
@media (max-width: 900px) {
  .overview, .overview tbody, .overview tr { display: block; font-size: 13px; }
  .overview tr:first-child { display: none; }
  .overview tr { columns: 2 9.5rem; column-gap: .5rem; margin-bottom: .8rem; }
  .overview .who { display: block; width: auto; column-span: all; border: 0; }
  .overview small { display: inline; margin-left: .5em; }
  .overview td { display: flex; justify-content: space-between; gap: .5rem; text-align: right;
    break-inside: avoid; padding: .2rem .4rem; }
  .overview .absent { display: none; }
  .overview .good, .overview .fair, .overview .poor { white-space: nowrap; }
  .overview td::before { white-space: normal; content: attr(data-column); text-align: left; }
}
@media (prefers-color-scheme: dark) {
  body { background: #14181c; color: #e4e8eb; }
  .none, .absent { color: #a7b0b8; }
  th, td, section { border-color: #454d55; }
}
</style>
</head>
<body>
<h1>Who holds, and who creeps</h1>
<p>Errors at the middle resolution against closed forms: within 1 % green, within 5 % yellow.
In brackets: of a coarser mesh, where the middle one has no value.
The verdict is that of creep: "holds" is less than 0.1 mm in 10 s at 90 % of the angle of slip,
awake. "Not supported": the adapter lacks a capability. "Not requested": no run asked for it.
A dash: not repeated with calibrated bending. †: wrong because of a fault named below. Made by
stickslip-measure $version.</p>
<table class="overview">
$overview
</table>
<ul>$findings</ul>
<h2>Rules</h2>
<ul>
<li>A simulator has its defaults, and a row that its own documentation recommends.</li>
<li>Friction is never calibrated. Bending is, in a row of its own.</li>
<li>The slope goes down along no edge of a mesh.</li>
<li>A patch that holds is pushed at the end: one that stands still then "sleeps".</li>
<li>Limit and order are stated only where three resolutions converge.</li>
<li>A scene that could not be set up, was not finished or not run has not failed.</li>
</ul>
<h2>Experiments</h2>
$experiments
<h2>Simulators</h2>
$simulators
</body>
</html>
""")
