"""A part of a dataset version: some of its arrays, and the samples of a split or with given labels.

Labels are small and come with every part, so `arrays` chooses among the others: pictures, clips,
curves and meshes.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, ValidationError

from stickslip_schemas.base import Document, Sha256
from stickslip_schemas.format.manifest import GROUP_NAME, Contents, FileEntry, layout
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout
from stickslip_schemas.spec.names import did_you_mean

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

SELECTION_NAME = "selection.json"
"""The file that says which part of a version a directory holds; it is not in a directory that holds
all of it.
"""

Labels = Callable[[str], "npt.NDArray[Any]"]
"""Gives a label of all slots, (slots,) or (slots, n), by its name."""

_ORDERED = ("<=", ">=", "<", ">")
_EQUAL = ("==", "=")
_OPERATORS = ("<=", ">=", "==", "!=", "<", ">", "=")
"""Operators of a condition, the longer ones first: `<` must not be read from `<=`."""
_CONDITION = re.compile(
    rf"\s*(?P<label>[^<>=!]+?)\s*(?P<operator>{'|'.join(_OPERATORS)})\s*(?P<value>\S.*?)\s*"
)
"""A label may have any character that no operator has, as in `scarf.areal_density<1`."""
_TRUTH = {"true": True, "false": False}
ROUNDING = 1e-6
"""Relative difference below which a number means a value of a label.

Axes of evenly spaced values have rounding errors, such as 0.30000000000000004 for 0.3, and some
labels are single precision, whose rounding errors are 6e-8.
"""
ROUNDING_OF_ZERO = 1e-12
"""The same below which a value means 0, relative to the largest value: -5.6e-17 in an axis to 1."""
_NEAREST = 3
"""Values of a label that a message names."""


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
        """Return the part that options of a command choose.

        Args:
            arrays: Names with commas between; None for all arrays.
            split: Name of a split; None for all samples.
            where: Conditions on labels.

        Raises:
            ValueError: An option has no sense.
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
        """Return the samples of the part as a mask of slots, bool (slots,).

        A sample of the part is valid, of the split, and holds to all conditions.

        Raises:
            ValueError: A condition makes no sense for its label, or no sample is chosen.
        """
        by_name = {array.name: array for array in arrays}
        chosen = label("valid").astype(bool)
        if self.split is not None:
            chosen &= label("split") == SPLITS.index(self.split)
        for condition in self.where:
            chosen &= _Condition.parse(condition, by_name).holds(label)
        if not chosen.any() and not self.is_everything:
            split = [f"split {self.split}"] if self.split else []
            conditions = ", ".join([*split, *self.where]) or "all samples"
            raise ValueError(f"no valid sample is in this part of the dataset: {conditions}")
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
    # Without labels nobody knows which samples are chosen.
    slots = None if label is None else np.flatnonzero(selection.choose_samples(arrays, label))
    paths: set[str] = set()
    for array in chosen_arrays:
        if array.is_label or slots is not None:
            paths.add(f"{array.name}/{GROUP_NAME}")
        # All files of a label: a reader needs them to choose again.
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
    selected_files = [
        file
        for file in manifest.files
        if file.path in paths or file.path.split("/")[0] not in names
    ]
    if manifest.sections and label is not None:
        for number in sections_of(contents, selection, label):
            selected_files.append(manifest.sections[number])
            selected_files += [
                file for file in contents.section(number).files if file.path in paths
            ]
    return selected_files


def sections_of(contents: Contents, selection: Selection, label: Labels) -> list[int]:
    """Return the numbers of the sections of a manifest that list the samples of a part.

    0 is all of a small one.
    """
    import numpy as np

    slots = np.flatnonzero(selection.choose_samples(layout(contents.manifest.spec), label))
    return sorted({contents.number_of(slot) for slot in slots.tolist()})


class PartDocument(Document):
    """The file `selection.json`: the version, and the part of it that the directory holds."""

    manifest: Sha256
    selection: Selection


@dataclass(frozen=True)
class _Condition:
    """A condition on a label of one number, which has been checked against the layout."""

    text: str
    array: ArrayLayout
    operator: str
    value: str

    @classmethod
    def parse(cls, text: str, arrays: Mapping[str, ArrayLayout]) -> "_Condition":
        """Read a condition such as `mu<0.5`.

        Raises:
            ValueError: It is no condition, or makes no sense for the label.
        """
        parts = _CONDITION.fullmatch(text)
        if parts is None:
            raise ValueError(
                f"where must be a label, one of {' '.join(_OPERATORS)}, and a value, as in "
                f"'mu<0.5'; and is {text!r}"
            )
        name = parts["label"]
        array = arrays.get(name)
        if array is None or array.shape or not array.is_label:
            single = [array.name for array in arrays.values() if array.is_label and not array.shape]
            raise ValueError(
                f"where must name one of the labels {', '.join(single)}; and is {text!r}"
                f"{did_you_mean(name, single)}"
            )
        has_order = not array.categories and array.dtype != "bool"
        if parts["operator"] in _ORDERED and not has_order:
            raise ValueError(
                f"where must compare {name} with == or !=, for it has no order; and is {text!r}"
            )
        return cls(text, array, parts["operator"], parts["value"])

    def holds(self, label: Labels) -> "npt.NDArray[np.bool_]":
        """Return which slots hold to the condition, bool (slots,).

        Raises:
            ValueError: No sample has the value that the label must equal.
        """
        import numpy as np  # the extra `arrays`

        values = label(self.array.name)
        if self.array.categories or self.array.dtype == "bool":
            is_equal = np.asarray(values == self._code(), dtype=bool)
            return ~is_equal if self.operator == "!=" else is_equal
        number = self._number()
        # A value that differs from the number by rounding only is equal to it, for every operator.
        largest = float(np.nanmax(np.abs(values), initial=0.0))
        tolerance = max(ROUNDING * abs(number), ROUNDING_OF_ZERO * largest)
        is_equal = np.abs(values - number) <= tolerance
        if self.operator in _EQUAL:
            is_valid = label("valid").astype(bool)
            if not is_equal[is_valid].any():
                self._refuse_no_value(values[is_valid], number)
            return np.asarray(is_equal, dtype=bool)
        masks = {
            "!=": ~is_equal,
            "<": (values < number) & ~is_equal,
            ">": (values > number) & ~is_equal,
            "<=": (values < number) | is_equal,
            ">=": (values > number) | is_equal,
        }
        return np.asarray(masks[self.operator], dtype=bool)

    def _refuse_no_value(self, values: "npt.NDArray[Any]", number: float) -> None:
        """Raise ValueError with the nearest values: no valid sample has the number."""
        import numpy as np

        distinct = np.unique(values[np.isfinite(values)])
        if not distinct.size:
            return  # another message says that no sample is valid
        nearest = distinct[np.argsort(np.abs(distinct - number))[:_NEAREST]]
        raise ValueError(
            f"no sample has {self.array.name} {self.value}: the nearest values are "
            f"{', '.join(f'{value:.9g}' for value in sorted(nearest.tolist()))}; where is "
            f"{self.text!r}"
        )

    def _code(self) -> int | bool:
        """Return the code of a category, or a truth value."""
        array = self.array
        if array.categories:
            if self.value in array.categories:
                return array.categories.index(self.value)
            raise ValueError(
                f"{array.name} must be one of {', '.join(array.categories)}; where is "
                f"{self.text!r}{did_you_mean(self.value, array.categories)}"
            )
        if self.value.lower() in _TRUTH:
            return _TRUTH[self.value.lower()]
        raise ValueError(f"{array.name} must be true or false; where is {self.text!r}")

    def _number(self) -> float:
        try:
            number = float(self.value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ValueError(
                f"{self.array.name} must be compared with a number; where is {self.text!r}"
            )
        return number
