"""Output of the commands: messages, tables and JSON, which fit the terminal and never steer it."""

import json
import math
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TextIO

import click
from pydantic import BaseModel, JsonValue

from stickslip_services.client.answers import printable

GAP = 2
"""Spaces between two columns of a table."""
LEAST_SENTENCE = 30
"""Least width of a column of sentences [characters], if the terminal has so many."""
LEAST_WIDTH = 20
"""Narrower terminals are treated as if they were so wide [characters]."""


class Styled(NamedTuple):
    """A cell with a colour."""

    text: str
    color: str | None


Cell = str | Styled


def columns(stream: TextIO | None = None) -> int:
    """Return the width of the output [characters].

    COLUMNS decides, then the terminal. Without both there is no limit, because a program reads.
    """
    stream = stream or sys.stdout
    if "COLUMNS" in os.environ or stream.isatty():
        return max(LEAST_WIDTH, shutil.get_terminal_size().columns)
    return sys.maxsize


def say(text: str) -> None:
    """Print a message for people on standard error; standard output is for programs."""
    click.echo(_wrap(text, columns(sys.stderr)), err=True)


def tell(text: str) -> None:
    """Print an answer of a few sentences on standard output."""
    click.echo(_wrap(text, columns()))


def print_error(message: str) -> None:
    """Print a message that begins with `error:`, on standard error."""
    # The style is added after wrapping, because its codes have no width.
    text = _wrap(f"error: {message}", columns(sys.stderr))
    styled = click.style("error:", bold=True, fg="red")
    click.echo(styled + text.removeprefix("error:"), err=True)


def _wrap(text: str, width: int) -> str:
    """Return text whose lines are broken between words, further lines indented with the first."""
    lines = []
    for line in text.split("\n"):
        indent = line[: len(line) - len(line.lstrip(" "))]
        # Long words are commands, paths and URLs: broken, nobody could copy them.
        pieces = textwrap.wrap(
            line,
            width,
            subsequent_indent=f"{indent}  " if indent else "",
            break_long_words=False,
            break_on_hyphens=False,
            drop_whitespace=True,
        )
        lines += pieces or [""]
    return "\n".join(lines)


def print_json(value: BaseModel | Sequence[BaseModel] | JsonValue) -> None:
    """Print a JSON document for programs."""
    click.echo(json.dumps(strict_json(value), indent=2, allow_nan=False))


def print_json_line(value: JsonValue) -> None:
    """Print a JSON document on one line, for programs that read a stream."""
    click.echo(json.dumps(strict_json(value), allow_nan=False))


def strict_json(value: BaseModel | Sequence[BaseModel] | JsonValue) -> JsonValue:
    """Return a value as JSON has it [RFC 8259]: null for numbers that are not finite."""
    if isinstance(value, BaseModel):
        # pydantic writes null for NaN only into text, not into Python values.
        document: JsonValue = json.loads(value.model_dump_json())
        return document
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(name): strict_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict_json(item) for item in value]
    return value  # type: ignore[return-value]  # a sequence of models is a list or a tuple


def print_table(
    heads: Sequence[str], rows: Iterable[Sequence[Cell]], *, sentences: bool = False
) -> None:
    """Print rows under their heads.

    Args:
        heads: Name of each column, the most important one first; all empty for a table without
            heads. In a narrow terminal the last columns are left out.
        rows: Cells by column.
        sentences: Whether the last column is text, which stays and is wrapped between words.
    """
    # Cells are cleaned before they are measured: an escape sequence has no width.
    lines = [[_clean(cell) for cell in row] for row in rows]
    if any(heads):
        lines.insert(0, [Styled(head, None) for head in heads])
    if not lines:
        return
    widths = [max(len(line[column].text) for line in lines) for column in range(len(heads))]
    visible = _fit(widths, sentences=sentences)
    for number, line in enumerate(lines):
        is_head = number == 0 and any(heads)
        cells = [line[column] for column in visible]
        _print_row(cells, [widths[column] for column in visible], is_head=is_head)
    hidden = [head for column, head in enumerate(heads) if column not in visible]
    if hidden:
        # Some tables have no JSON form, and then only a wider terminal helps.
        context = click.get_current_context(silent=True)
        has_json = context is None or "as_json" in context.params
        rest = "--json" if has_json else "a wider terminal"
        say(f"not shown in {columns()} columns: {', '.join(hidden)}; {rest} shows all")


def print_fields(fields: Iterable[tuple[str, Cell]]) -> None:
    """Print names and their values, one a line."""
    print_table(("", ""), fields, sentences=True)


def _clean(cell: Cell) -> Styled:
    """Return a cell without characters that steer the terminal: its text may be a server's."""
    if isinstance(cell, Styled):
        return Styled(printable(cell.text), cell.color)
    return Styled(printable(cell), None)


def _fit(widths: list[int], *, sentences: bool) -> list[int]:
    """Return the columns that fit the terminal, and narrow the widths of columns of text."""
    width = columns()
    visible = list(range(len(widths)))
    if sentences:
        # Text takes the rest of the line, and at least a few words.
        rest = width - sum(widths[:-1]) - GAP * (len(widths) - 1)
        widths[-1] = min(widths[-1], max(LEAST_SENTENCE, rest))
    required = 2 if sentences else 1
    while len(visible) > required and _total(widths, visible) > width:
        # Columns come by importance. The text of the last one says what is wrong: it stays.
        visible.pop(-required)
    if _total(widths, visible) > width:
        _narrow(widths, visible, width)
    return visible


def _narrow(widths: list[int], visible: list[int], width: int) -> None:
    """Narrow the one or two columns that are left, so that their cells take several lines."""
    first = visible[0]
    if len(visible) == 1:
        widths[first] = width
        return
    # The text gets the rest of the line, and at least half of it.
    last = visible[1]
    half = (width - GAP) // 2
    widths[last] = min(widths[last], max(half, width - GAP - widths[first]))
    widths[first] = min(widths[first], width - GAP - widths[last])


def _total(widths: list[int], visible: list[int]) -> int:
    return sum(widths[column] for column in visible) + GAP * (len(visible) - 1)


def _print_row(cells: list[Styled], widths: list[int], *, is_head: bool) -> None:
    """Print a row of a table; cells that are wider than their column take several lines."""
    wrapped = [
        textwrap.wrap(cell.text, width, break_on_hyphens=False) or [""]
        for cell, width in zip(cells, widths, strict=True)
    ]
    for number in range(max(len(lines) for lines in wrapped)):
        parts = []
        for cell, lines, width in zip(cells, wrapped, widths, strict=True):
            text = lines[number] if number < len(lines) else ""
            # Blanks stand outside of the style, or they would be coloured and never stripped.
            style = click.style(text, bold=is_head or None, fg=cell.color) if text else ""
            parts.append(style + " " * (width - len(text)))
        click.echo((" " * GAP).join(parts).rstrip())
