"""A part of a dataset version: some of its arrays, and the samples of a split or with given labels.

Labels are small and come with every part, so `arrays` chooses among the others: pictures, clips,
curves and meshes.
"""

import operator
import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, ValidationError

from stickslip_schemas.base import Document, Sha256
from stickslip_schemas.format.manifest import GROUP_NAME, Contents, FileEntry, layout
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

SELECTION_NAME = "selection.json"
"""The file that says which part of a version a directory holds; it is not in a directory that holds
all of it.
"""

Labels = Callable[[str], "npt.NDArray[Any]"]
"""Gives a label of all slots, (slots,) or (slots, n), by its name."""

_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "=": operator.eq,
}
_CONDITION = re.compile(rf"\s*(\w+)\s*({'|'.join(_OPERATORS)})\s*(\S.*?)\s*")
_TRUTH = {"true": True, "false": False}


class Selection(Document):
    """Which part of a version is meant; without any field, all of it."""

    arrays: tuple[str, ...] | None = Field(
        default=None, description="null: all; labels are always in"
    )
    split: Literal["train", "validation", "test"] | None = None
    where: tuple[str, ...] = Field(
        default=(),
        description="conditions that all hold: a label, one of < <= > >= == !=, and a value",
    )

    @classmethod
    def of_options(
        cls, arrays: str | None, split: str | None, where: Iterable[str] | None
    ) -> "Selection":
        """Return the selection that options of a command describe; raise ValueError.

        `arrays` are names with commas between.
        """
        names = (
            None
            if arrays is None
            else tuple(filter(None, (name.strip() for name in arrays.split(","))))
        )
        try:
            return cls.model_validate(
                {"arrays": names, "split": split, "where": tuple(where or ())}
            )
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise ValueError(
                f"{first['loc'][0]}: {first['msg']}, and is {first['input']!r}"
            ) from None

    @property
    def is_everything(self) -> bool:
        return self == Selection()

    def choose_arrays(self, arrays: Iterable[ArrayLayout]) -> tuple[ArrayLayout, ...]:
        """Return the arrays of the part, in the order of the version.

        Raise ValueError for a name that it lacks.
        """
        arrays = tuple(arrays)
        if self.arrays is None:
            return arrays
        names = [array.name for array in arrays]
        for name in self.arrays:
            if name not in names:
                raise ValueError(f"arrays must be some of {', '.join(names)}, got {name!r}")
        return tuple(array for array in arrays if array.is_label or array.name in self.arrays)

    def choose_samples(
        self, arrays: Iterable[ArrayLayout], label: Labels
    ) -> "npt.NDArray[np.bool_]":
        """Return the chosen slots, bool (slots,).

        A chosen sample is valid, of the split, and meets all conditions.

        Raises ValueError for a condition that makes no sense for its label.
        """
        by_name = {array.name: array for array in arrays}
        chosen = label("valid").astype(bool)
        if self.split is not None:
            chosen &= label("split") == SPLITS.index(self.split)
        for condition in self.where:
            chosen &= _holds(condition, by_name, label)
        return chosen


def part_files(contents: Contents, selection: Selection, label: Labels | None) -> list[FileEntry]:
    """Return the listed files that a part of a version consists of.

    Without `label`, these are the files that one needs to know the labels, which tell what else
    belongs to the part.
    """
    if selection.is_everything:
        return list(contents.files())
    import numpy as np  # the extra `arrays`

    manifest = contents.manifest
    arrays = layout(manifest.spec)
    chosen_arrays = selection.choose_arrays(arrays)
    names = {array.name for array in arrays}
    slots = None if label is None else np.flatnonzero(selection.choose_samples(arrays, label))
    paths: set[str] = set()
    for array in chosen_arrays:
        if array.is_label or slots is not None:
            paths.add(f"{array.name}/{GROUP_NAME}")
        if array.is_label:
            count = -(-manifest.sample_count // manifest.spec.samples_per_file(array))
            paths.update(array.shard_path(number) for number in range(count))
        elif slots is not None:
            paths.update(
                map(
                    array.shard_path,
                    np.unique(slots // manifest.spec.samples_per_file(array)).tolist(),
                )
            )
    found = [
        file
        for file in manifest.files
        if file.path in paths or file.path.split("/")[0] not in names
    ]
    if manifest.sections and label is not None:
        for number in sections_of(contents, selection, label):
            found.append(manifest.sections[number])
            found += [file for file in contents.section(number).files if file.path in paths]
    return found


def sections_of(contents: Contents, selection: Selection, label: Labels) -> list[int]:
    """Return the numbers of the sections of a manifest that list the samples of a part.

    0 is all of a small one.
    """
    import numpy as np

    slots = np.flatnonzero(selection.choose_samples(layout(contents.manifest.spec), label))
    return sorted({contents.number_of(slot) for slot in slots.tolist()})


class PartDocument(Document):
    """What `selection.json` says: of which version the directory holds a part, and which part."""

    manifest: Sha256
    selection: Selection


def _holds(
    condition: str, arrays: dict[str, ArrayLayout], label: Labels
) -> "npt.NDArray[np.bool_]":
    import numpy as np

    parts = _CONDITION.fullmatch(condition)
    if parts is None:
        raise ValueError(
            f"where must be a label, one of {' '.join(_OPERATORS)}, and a value, as in 'mu<0.5'; "
            f"and is {condition!r}"
        )
    name, sign, value = parts.groups()
    array = arrays.get(name)
    if array is None or array.shape or not array.is_label:
        single = [array.name for array in arrays.values() if array.is_label and not array.shape]
        raise ValueError(
            f"where must name one of the labels {', '.join(single)}; and is {condition!r}"
        )
    if (array.categories or array.dtype == "bool") and sign not in ("=", "==", "!="):
        raise ValueError(
            f"where must compare {name} with == or !=, for it has no order; and is {condition!r}"
        )
    return np.asarray(_OPERATORS[sign](label(name), _value(array, value, condition)), dtype=bool)


def _value(array: ArrayLayout, text: str, condition: str) -> float | int | bool:
    if array.categories:
        if text in array.categories:
            return array.categories.index(text)
        raise ValueError(
            f"{array.name} must be one of {', '.join(array.categories)}; where is {condition!r}"
        )
    if array.dtype == "bool":
        if text.lower() in _TRUTH:
            return _TRUTH[text.lower()]
        raise ValueError(f"{array.name} must be true or false; where is {condition!r}")
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"{array.name} must be compared with a number; where is {condition!r}"
        ) from None
