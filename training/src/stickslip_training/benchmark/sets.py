"""Which named test sets there are, and whether a dataset is one of them.

A set is a spec, and the split of its dataset to answer, or all of it. Builds of the code differ between
machines, and so do manifests. What identifies a set is therefore what its samples hold:

  * the labels that follow from the spec, slot by slot, to the last bit: a digest;
  * a little of what methods see, and of truths that are computed, to within a tolerance: an array.

The manifests of versions that were published stand beside it, so that a table can tell entries on the published bytes
from those on a set that was remade.
"""

import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from stickslip_schemas.base import canonical_json, sha256
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_training.arrays import Array, Integers
from stickslip_training.benchmark.cloth import ClothTask
from stickslip_training.benchmark.rods import RodTask
from stickslip_training.benchmark.task import Task
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
    published: tuple[str, ...]
    """Digests of the manifests of versions that were published."""
    seen: dict[str, Array]

    @property
    def parsed_spec(self) -> JobSpec:
        """The spec with all defaults of this build."""
        return job_spec_adapter.validate_python(self.spec)

    @property
    def task(self) -> Task:
        return TASKS[str(self.parsed_spec.kind)]

    def check(self, reader: DatasetReader) -> tuple[Integers, Making]:
        """Return the slots to answer, and whether the dataset is a published version or was remade.

        Raises ValueError where the dataset is not this set.
        """
        refused = f"the dataset must be the test set {self.name}, and is not: "
        if reader.spec.content_digest != self.parsed_spec.content_digest:
            raise ValueError(
                f"{refused}its spec is another one. `stickslip-train benchmark spec {self.name}` prints it"
            )
        slots = reader.slots(self.split)
        if (found := labels_digest(self.task, reader, slots)) != self.labels:
            raise ValueError(
                f"{refused}the labels of its {len(slots)} samples to answer have SHA-256 {found}, and those of the set "
                f"{self.labels}. Samples were rejected here, or the dataset is in parts"
            )
        for name, found_here in self.task.seen(reader, slots).items():
            off, allowed = np.abs(found_here - self.seen[name].astype(np.float64)).max(), self.task.tolerances[name]
            if not off <= allowed:
                raise ValueError(
                    f"{refused}{name} differs by up to {off:.3g}, and {allowed:g} is allowed. This build or machine "
                    "makes other samples: take a published version"
                )
        return slots, "published" if reader.manifest_digest in self.published else "remade"


def set_names() -> tuple[str, ...]:
    return tuple(sorted(file.stem for file in SETS.glob("*.json")))


def load_set(name: str) -> NamedSet:
    """Return a set; raise ValueError if the name is unknown."""
    if name not in set_names():
        raise ValueError(f"the test set must be one of {', '.join(set_names())}, and is {name!r}")
    document = json.loads((SETS / f"{name}.json").read_text(encoding="utf-8"))
    with np.load(SETS / f"{name}.npz") as file:
        seen = {each: file[each] for each in file.files}
    return NamedSet(
        name=name,
        about=document["about"],
        spec=document["spec"],
        labels=document["labels"],
        split=document["split"],
        published=tuple(document["published"]),
        seen=seen,
    )


def frozen(
    name: str, about: str, spec: dict[str, Any], split: Split | None, reader: DatasetReader
) -> tuple[bytes, bytes]:
    """Return the files NAME.json and NAME.npz of a new set, whose published version the reader has open."""
    task = TASKS[reader.kind]
    slots = reader.slots(split)
    seen = task.seen(reader, slots)
    new = NamedSet(name, about, spec, labels_digest(task, reader, slots), split, (reader.manifest_digest,), seen)
    new.check(reader)
    document = {"about": about, "split": split, "labels": new.labels, "published": [*new.published], "spec": spec}
    packed = BytesIO()
    np.savez_compressed(packed, **seen)  # type: ignore[arg-type]  # its stub takes no dictionary
    return (json.dumps(document, indent=2) + "\n").encode(), packed.getvalue()


def labels_digest(task: Task, reader: DatasetReader, slots: Integers) -> str:
    """Return the SHA-256 of the labels of slots."""
    return sha256(canonical_json(task.labels(reader, slots)).encode())
