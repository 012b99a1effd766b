"""The documentation site: `make docs` builds it into build/docs, and a warning is an error."""

from collections.abc import Callable, Iterator
from importlib import import_module, metadata
from typing import Any

import click.testing
import stickslip_services.cli
import stickslip_training.cli
import typer.testing
from sphinx.ext.napoleon import Config, GoogleDocstring

project = "stickslip"
author = "The stickslip authors"
release = metadata.version("stickslip")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["README.md"]
html_theme = "furo"
html_title = "stickslip"
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"

MODULES = (
    "stickslip",
    "stickslip_schemas.kinds",
    "stickslip_schemas.spec.jobs",
    "stickslip_sim_core",
    "stickslip_sim_core.protocols",
    "stickslip_training.data.reader",
    "stickslip_training.data.samples",
)


def _commands(group: Any, help_of: Callable[[list[str]], str], path: list[str]) -> Iterator[str]:
    """Yield the help of the commands of a group as sections."""
    for name in group.list_commands(group.context_class(group)):
        words = [*path, name]
        text = help_of([*words[1:], "--help"])
        yield f"{'#' * len(words)} {' '.join(words)}\n\n```text\n{text.strip()}\n```\n"
        found = group.resolve_command(group.context_class(group), [name])[1]
        if hasattr(found, "list_commands"):
            yield from _commands(found, help_of, words)


def _command_reference() -> str:
    wide = {"COLUMNS": "100", "TERM": "dumb"}
    ours, training = stickslip_services.cli.app, stickslip_training.cli.app
    runs = click.testing.CliRunner(), typer.testing.CliRunner()
    sections = [
        *_commands(
            ours,
            lambda words: runs[0].invoke(ours, words, env=wide, prog_name="stickslip").stdout,
            ["stickslip"],
        ),
        *_commands(
            typer.main.get_command(training),
            lambda words: (
                runs[1].invoke(training, words, env=wide, prog_name="stickslip-train").stdout
            ),
            ["stickslip-train"],
        ),
    ]
    return "\n".join(sections)


def _python_reference() -> str:
    sections = []
    for name in MODULES:
        gathers = "   :imported-members:\n" if hasattr(import_module(name), "__all__") else ""
        sections.append(
            f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n{gathers}```\n"
        )
    return "\n".join(sections)


GENERATED = {"commands": _command_reference, "python-reference": _python_reference}
"""What completes a page."""


def _complete(_: Any, page: str, source: list[str]) -> None:
    if page in GENERATED:
        source[0] += f"\n{GENERATED[page]()}"


def _docstring(_: Any, what: str, *event: Any) -> None:
    """Read the sections of a docstring, in which |x| and x* are mathematics and no markup."""
    lines = event[-1]
    lines[:] = [line.replace("|", r"\|").replace("*", r"\*") for line in lines]
    if what not in (
        "attribute",
        "data",
        "property",
    ):  # of these, Napoleon takes the words before a colon for a type
        lines[:] = GoogleDocstring(lines, Config(), what=what).lines()


def setup(app: Any) -> None:
    """Let Sphinx complete these pages in every build."""
    app.connect("source-read", _complete)
    app.connect("autodoc-process-docstring", _docstring)
    app.connect("env-get-outdated", lambda *_: list(GENERATED))
