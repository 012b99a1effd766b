"""New test sets, for `benchmarks/training/freeze_set.py` and for tests."""

import json
from io import BytesIO
from typing import Any

import numpy as np
from stickslip_training.benchmark.sets import TASKS, NamedSet, labels_digest
from stickslip_training.data.reader import DatasetReader, Split


def frozen(
    name: str, about: str, spec: dict[str, Any], split: Split | None, reader: DatasetReader
) -> tuple[bytes, bytes]:
    """Return the files NAME.json and NAME.npz of a new set.

    The reader has its published version open.
    """
    task = TASKS[reader.kind]
    slots = reader.slots(split)
    control_values = task.control_values(reader, slots)
    new = NamedSet(
        name,
        about,
        spec,
        labels_digest(task, reader, slots),
        split,
        (reader.manifest_digest,),
        control_values,
    )
    new.check(reader)
    document = {
        "about": about,
        "split": split,
        "labels": new.labels,
        "published": [*new.published],
        "spec": spec,
    }
    packed = BytesIO()
    np.savez_compressed(packed, **control_values)  # type: ignore[arg-type]  # its stub takes no dictionary
    return (json.dumps(document, indent=2) + "\n").encode(), packed.getvalue()
