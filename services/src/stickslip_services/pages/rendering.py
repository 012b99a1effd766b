"""Pages from templates, and plots for the script of the pages; all that they load is in `static/`."""

import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import yaml
from fastapi import Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.units import duration, size

STATIC = Path(__file__).parent / "static"


_POLICY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def html_page(template: str, status: int = 200, **values: Any) -> Response:
    """Return a rendered template, all of whose values are escaped, as a response with its security headers."""
    content = _environment().get_template(template).render(**values)
    return Response(content, status, media_type="text/html", headers=_POLICY)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.policies["json.dumps_kwargs"] = {}  # curves keep their order
    made.filters |= {each.__name__: each for each in (duration, size, number, moment, ago, words)}
    return made


def spec_text(spec: JobSpec) -> str:
    """Return a spec as YAML, with short forms of its axes: a list, or the only value."""
    document = spec.model_dump(mode="json", exclude_defaults=True) | {"kind": spec.kind}
    for name, axis in document["axes"].items():
        if axis["type"] == "list":
            document["axes"][name] = axis["values"][0] if len(axis["values"]) == 1 else axis["values"]
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, default_flow_style=None)


def number(value: object) -> str:
    """Return a value of a label as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def moment(value: datetime | None) -> str:
    return "" if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def ago(value: datetime) -> str:
    return f"{duration(max(0.0, time.time() - value.astimezone(UTC).timestamp()))} ago"


def words(value: object) -> str:
    """Return the name of a state or reason as words, without underscores."""
    return str(value).replace("_", " ")


def table(x: Iterable[float], curves: Mapping[str, Iterable[float]], *, is_dots: bool = False) -> dict[str, Any]:
    """Return curves, or dots, by name, over ascending x. What is not finite leaves a gap."""
    known = {name: [value if isfinite(value) else None for value in values] for name, values in curves.items()}
    return {"x": list(x), "curves": known, "dots": is_dots}


def plot(
    *tables: dict[str, Any], x_name: str, y_name: str, is_log: bool = False, is_timed: bool = False
) -> dict[str, Any]:
    """Return a plot for the macro `plot`: curves and dots with the names and units of both axes.

    Logarithmic scales are for values that are all positive; on a plot over time, the cursor of the page is drawn.
    """
    return {"tables": tables, "x": x_name, "y": y_name, "log": is_log, "timed": is_timed}
