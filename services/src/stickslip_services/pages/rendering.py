"""Templates to HTML. A page works without anything from elsewhere: styles and scripts are in `static/`."""

import time
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from stickslip_schemas.base.states import TaskState
from stickslip_schemas.documents.responses import StageProgress

STATIC = Path(__file__).parent / "static"

_OVER = (TaskState.succeeded, TaskState.rejected, TaskState.failed)
"""Done; a cancelled task is not."""


def render(template: str, **context: Any) -> str:
    """Return the HTML of a template; everything that it shows is escaped."""
    return _environment().get_template(template).render(**context)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "duration": duration,
        "size": size,
        "number": number,
        "moment": moment,
        "ago": ago,
        "over": over,
        "words": words,
    }
    return made


def duration(seconds: float | None) -> str:
    """Return a time span: 4 ms, 0.4 s, 9 s, 4 min, 2 h 10 min."""
    if seconds is None:
        return "unknown"
    if 0 < seconds < 0.1:
        return f"{1000 * seconds:.2g} ms"
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def size(count: float) -> str:
    """Return a number of bytes: 512 B, 13.5 kB, 1.2 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 100 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def number(value: object) -> str:
    """Return a value of a label as people read it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def moment(value: datetime | None) -> str:
    """Return a point in time, in UTC."""
    return "" if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def ago(value: datetime) -> str:
    """Return how long ago something was."""
    return f"{duration(max(0.0, time.time() - value.astimezone(UTC).timestamp()))} ago"


def over(progress: StageProgress) -> int:
    """Return how many tasks of a stage are done, whether they succeeded or not."""
    return sum(progress.counts.get(state, 0) for state in _OVER)


def words(value: object) -> str:
    """Return the name of a state or reason as words."""
    return str(value).replace("_", " ")
