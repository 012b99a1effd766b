"""Named test sets, and entries: records of scores, and their table.

A set is a spec, and the split of its dataset to answer, or all of it. Builds of the code differ
between machines, and so do manifests. So the content of its samples identifies a set:

  * the labels that follow from the spec, slot by slot, to the last bit: a digest;
  * a little of what methods see, and of truths that are computed, to within a tolerance: an array.

The manifests of versions that were published stand beside it, so that a table can tell entries on
the published bytes from entries on a set that was remade.
"""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from stickslip_schemas.base import canonical_json, sha256
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_training.arrays import Array, Integers
from stickslip_training.benchmark.clip_sets import clip_set_names
from stickslip_training.benchmark.tasks import ClothTask, RodTask, Task
from stickslip_training.data.reader import DatasetReader, Split

SETS = Path(__file__).parent / "sets"

TASKS: dict[str, Task] = {"cloth_drag": ClothTask(), "rod_hang": RodTask()}
"""By kind of dataset."""

Making = Literal["published", "remade"]


@dataclass(frozen=True, eq=False)
class NamedSet:
    """A test set."""

    name: str
    about: str
    spec: dict[str, Any]
    """As a user writes it; `stickslip submit` takes it."""
    labels: str
    """SHA-256 of the labels of the samples to answer."""
    split: Split | None
    """Of the samples to answer; None: all."""
    published: Sequence[str]
    """Digests of the manifests of versions that were published."""
    control_values: dict[str, Array]

    @property
    def parsed_spec(self) -> JobSpec:
        """The spec with all defaults of this build."""
        return job_spec_adapter.validate_python(self.spec)

    @property
    def task(self) -> Task:
        return TASKS[str(self.parsed_spec.kind)]

    def check(self, reader: DatasetReader) -> tuple[Integers, Making]:
        """Return the slots to answer, and whether the dataset is a published version or was remade.

        Raises ValueError if the dataset is not this set.
        """
        refused = f"the dataset must be the test set {self.name}, and is not: "
        if reader.spec.content_digest != self.parsed_spec.content_digest:
            raise ValueError(
                f"{refused}its spec is another one. `stickslip-train benchmark spec "
                f"{self.name}` prints it"
            )
        slots = reader.slots(self.split)
        if (digest := labels_digest(self.task, reader, slots)) != self.labels:
            raise ValueError(
                f"{refused}the labels of its {len(slots)} samples to answer have SHA-256 "
                f"{digest}, and those of the set "
                f"{self.labels}. Samples were rejected here, or the dataset is in parts"
            )
        for name, actual in self.task.control_values(reader, slots).items():
            off = np.abs(actual - self.control_values[name].astype(np.float64)).max()
            allowed = self.task.tolerances[name]
            if not off <= allowed:
                raise ValueError(
                    f"{refused}{name} differs by up to {off:.3g}, and {allowed:g} is "
                    "allowed. This build or machine "
                    "makes other samples: take a published version"
                )
        return slots, "published" if reader.manifest_digest in self.published else "remade"


def set_names() -> tuple[str, ...]:
    """Return the names of all test sets, in alphabetical order."""
    return tuple(sorted(file.stem for file in SETS.glob("*.json")))


def load_set(name: str) -> NamedSet:
    """Return a set; raise ValueError if the name is unknown, or is that of a set of clips."""
    if name in clip_set_names():
        raise ValueError(
            f"the test set {name} has no spec: python benchmarks/training/clip_set.py {name} makes "
            "and scores it"
        )
    if name not in set_names():
        raise ValueError(f"the test set must be one of {', '.join(set_names())}, and is {name}")
    document = json.loads((SETS / f"{name}.json").read_text(encoding="utf-8"))
    with np.load(SETS / f"{name}.npz") as file:
        control_values = {each: file[each] for each in file.files}
    return NamedSet(name=name, control_values=control_values, **document)


def labels_digest(task: Task, reader: DatasetReader, slots: Integers) -> str:
    """Return the SHA-256 of the labels of slots."""
    return sha256(canonical_json(task.labels(reader, slots)).encode())


# --- entries
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Record:
    """Record of an entry."""

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

    def document(self) -> bytes:
        return (json.dumps(asdict(self), indent=1, allow_nan=False) + "\n").encode()


def enter(
    name: str,
    answers: Path,
    dataset: str,
    *,
    method: str,
    by: str,
    trained_on: str,
    link: str | None = None,
) -> Record:
    """Score a file of answers to the test set `name`.

    Raises ValueError if the file holds no list, or the dataset is not that set.
    """
    data = answers.read_bytes()
    answered = json.loads(data)
    if not isinstance(answered, list):
        raise ValueError(
            f"{answers} must hold a list of answers, and holds a {type(answered).__name__}"
        )
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
        raise ValueError(
            f"{path} must be a record of `stickslip-train benchmark score`: {error}"
        ) from None


def table(name: str, records: Iterable[Record]) -> str:
    """Return the Markdown table of the records of a set, best first."""
    task = load_set(name).task
    ranked = sorted(
        (record for record in records if record.set == name),
        key=lambda each: task.rank(each.scores),
    )
    titles = ("method", *task.columns, "trained on", "by", "set")
    lines = [_line(titles), "|---" * len(titles) + "|"]
    for record in ranked:
        method = record.method if record.link is None else f"[{record.method}]({record.link})"
        lines.append(
            _line((method, *task.row(record.scores), record.trained_on, record.by, record.making))
        )
    return "\n".join(lines)


def with_tables(page: str, records: Iterable[Record]) -> str:
    """Return a page with new tables between its marks.

    The marks are `<!-- results of NAME -->` and `<!-- end -->`.
    """
    known = list(records)
    place = re.compile(r"(<!-- results of (\S+) -->)\n.*?(<!-- end -->)", flags=re.S)
    changed, count = place.subn(
        lambda match: f"{match[1]}\n{table(match[2], known)}\n{match[3]}", page
    )
    missing = {record.set for record in known} - set(re.findall(r"<!-- results of (\S+) -->", page))
    if missing or not count:
        raise ValueError(
            "the page must have a place `<!-- results of NAME -->` for "
            f"{', '.join(sorted(missing))}"
        )
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
