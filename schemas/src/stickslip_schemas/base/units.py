"""Units of the numbers in documents: the description of a field ends with the unit of its numbers, as in `[m]`."""

import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

_RULES = ("greater_than", "greater_than_equal", "less_than", "less_than_equal", "float_type", "finite_number")
"""Types of pydantic's errors that are about a number."""


def unit_of(item: ErrorDetails, of: Any) -> str:
    """Return ` [unit]` of the number that an error is about, or an empty text.

    `of` is the type that the document was to be, a model or a union of models.
    """
    location = item["loc"]
    names = [place for place, part in enumerate(location) if isinstance(part, str) and item["type"] in _RULES]
    for place in reversed(names):
        for model in models_at(of, location[:place]):
            if (field := model.model_fields.get(str(location[place]))) is not None:
                unit = _said(field)
                return f" [{unit}]" if unit else ""
    return ""


def unit_in(document: Any, location: Sequence[int | str]) -> str:
    """Return the unit of the number at a place in a document; `1` of a pure number."""
    unit = ""
    for part in location:
        if isinstance(document, BaseModel):
            unit = _said(type(document).model_fields[str(part)])
            document = getattr(document, str(part))
        else:
            document = document[part]
    return unit or "1"


def _said(field: FieldInfo) -> str:
    unit = re.search(r"\[([^\]]+)\]", field.description or "")
    return unit[1] if unit else ""


def models_at(of: Any, location: Sequence[int | str]) -> list[type[BaseModel]]:
    """Return the models that a place in a document may hold, from the type of the whole."""
    models = list(_models_in(of))
    for part in location:
        fields = [model.model_fields[part] for model in models if part in model.model_fields]
        if fields:
            models = [found for field in fields for found in _models_in(field.annotation)]
        else:  # the place in a list, or the tag of a union
            tagged = [
                model
                for model in models
                if any(part in literals(field.annotation) for field in model.model_fields.values())
            ]
            models = tagged or models
    return models


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif get_origin(annotation) is not Literal:
        for argument in get_args(annotation):
            yield from _models_in(argument)


def literals(annotation: Any) -> list[str]:
    return [str(value) for value in get_args(annotation)] if get_origin(annotation) is Literal else []
