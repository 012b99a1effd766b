"""Entries: a file of answers, its scores as a record, and the table of all records."""

import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stickslip_schemas.base import sha256
from stickslip_schemas.store import write_durably

from stickslip_training.benchmark.sets import Making, load_set
from stickslip_training.data.reader import DatasetReader


@dataclass(frozen=True, kw_only=True)
class Record:
    """What is kept of an entry."""

    set: str
    method: str
    by: str
    trained_on: str
    """In the entrant's words; "nothing" for a method that learns nothing."""
    link: str | None
    """To code or a text."""
    making: Making
    """Of the set that was answered."""
    manifest: str
    """Digest of that dataset's manifest."""
    predictions: str
    """SHA-256 of the file of answers."""
    scores: dict[str, Any]

    def write(self, path: Path) -> None:
        """Write the record as JSON, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, (json.dumps(_rounded(asdict(self)), indent=1, allow_nan=False) + "\n").encode())


def enter(
    name: str, answers: Path, dataset: str, *, method: str, by: str, trained_on: str, link: str | None = None
) -> Record:
    """Score a file of answers to the test set `name`.

    Raises ValueError where the file holds no list, or the dataset is not that set.
    """
    data = answers.read_bytes()
    answered = json.loads(data)
    if not isinstance(answered, list):
        raise ValueError(f"{answers} must hold a list of answers, and holds a {type(answered).__name__}")
    chosen = load_set(name)
    with DatasetReader(dataset) as reader:
        slots, making = chosen.check(reader)
        scores = chosen.task.score(reader, slots, answered)
        manifest = reader.manifest_digest
    return Record(
        set=name,
        method=method,
        by=by,
        trained_on=trained_on,
        link=link,
        making=making,
        manifest=manifest,
        predictions=sha256(data),
        scores=_rounded(scores),
    )


def read_record(path: Path) -> Record:
    """Return the record of a file; raise ValueError if it is not one."""
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} must be a record of `stickslip-train benchmark score`: {error}") from None


def table(name: str, records: Iterable[Record]) -> str:
    """Return the Markdown table of the records of a set, best first."""
    task = load_set(name).task
    mine = sorted((record for record in records if record.set == name), key=lambda each: task.rank(each.scores))
    titles = ("method", *task.columns, "trained on", "by", "set")
    lines = [_line(titles), "|---" * len(titles) + "|"]
    for record in mine:
        method = record.method if record.link is None else f"[{record.method}]({record.link})"
        lines.append(_line((method, *task.row(record.scores), record.trained_on, record.by, record.making)))
    return "\n".join(lines)


def with_tables(page: str, records: Iterable[Record]) -> str:
    """Return a page in which what stands between `<!-- results of NAME -->` and `<!-- end -->` is that table."""
    known = list(records)

    def made(match: re.Match[str]) -> str:
        return f"{match[1]}\n{table(match[2], known)}\n{match[3]}"

    changed, count = re.subn(r"(<!-- results of (\S+) -->)\n.*?(<!-- end -->)", made, page, flags=re.S)
    missing = {record.set for record in known} - set(re.findall(r"<!-- results of (\S+) -->", page))
    if missing or not count:
        raise ValueError(f"the page must have a place `<!-- results of NAME -->` for {', '.join(sorted(missing))}")
    return changed


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _rounded(value: Any) -> Any:
    """Return plain values with six digits: the last ones differ between machines."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    return value
