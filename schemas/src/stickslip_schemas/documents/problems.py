"""Errors as problem documents [RFC 9457] that name the field, the rule and the value."""

import json
import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from itertools import islice
from typing import Any, NamedTuple

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails

from stickslip_schemas.base import literals, location_as_written, models_at, unit_of
from stickslip_schemas.spec.names import did_you_mean

PATTERN_RULES = {
    r"^[a-z0-9][a-z0-9-]{0,62}$": (
        "must be lower-case letters, digits and '-', 63 at most, the first one no '-'"
    ),
    r"^[a-z0-9][a-z0-9-]*$": "must be lower-case letters, digits and '-', the first one no '-'",
    r"^[a-z][a-z0-9_]{0,62}$": (
        "must be lower-case letters, digits and '_', 63 at most, a letter first"
    ),
    r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$": (
        "must be letters, digits, '_', '.' and '-', 63 at most, a letter or digit first"
    ),
    r"^[A-Za-z0-9_][A-Za-z0-9_./-]*$": (
        "must be a path of letters, digits, '_', '.', '-' and '/', a letter, digit or '_' first"
    ),
    r"^sha256:[0-9a-f]{64}$": "must be `sha256:` and 64 lower-case hexadecimal digits",
    r"^[0-9a-f]{64}$": "must be 64 lower-case hexadecimal digits",
}
"""The rule of each pattern of our documents, in words: nobody has to read an expression."""

MEDIA_TYPE = "application/problem+json"


class ProblemCode(StrEnum):
    """What went wrong, for programs."""

    validation_failed = "validation_failed"
    malformed_body = "malformed_body"
    body_too_large = "body_too_large"
    unauthorized = "unauthorized"
    scope_missing = "scope_missing"
    host_not_allowed = "host_not_allowed"
    origin_not_allowed = "origin_not_allowed"
    not_found = "not_found"
    method_not_allowed = "method_not_allowed"
    conflict = "conflict"
    idempotency_key_reused = "idempotency_key_reused"
    quota_exceeded = "quota_exceeded"
    kind_not_available = "kind_not_available"
    preset_not_certified = "preset_not_certified"
    stale_lease = "stale_lease"
    unknown_worker = "unknown_worker"
    storage_error = "storage_error"
    busy = "busy"
    too_many_streams = "too_many_streams"
    too_slow = "too_slow"
    internal_error = "internal_error"


class FieldError(BaseModel):
    """One thing wrong in a document."""

    pointer: str = Field(description="JSON pointer [RFC 6901] into the document as it was sent")
    rule: str = Field(description="the rule that does not hold, in words")
    value: str = Field(
        description="the offending value as JSON, cut to 200 characters; empty where it is missing"
    )


class Problem(BaseModel):
    """A problem document [RFC 9457].

    `type` is `urn:stickslip:problem:` with the code, which `title` says in words.
    """

    type: str
    title: str
    status: int
    detail: str
    code: ProblemCode
    instance: str | None = None
    request_id: str | None = None
    errors: list[FieldError] = Field(default_factory=list)


def field_errors(
    error: ValidationError, document: Any, expected: Any, *, at_most: int | None = None
) -> list[FieldError]:
    """Return one FieldError for each error of pydantic.

    Pointers lead into `document`, as the user wrote it.

    `expected` is the type of the document, a model or a union of models. Misspelt words are
    compared with its fields and values. This takes time for each error: `at_most` bounds it for a
    document with many.
    """
    items = (item for item in error.errors(include_url=False) if not _is_echo(item))
    return [_field_error(item, document, expected) for item in islice(items, at_most)]


def _is_echo(item: ErrorDetails) -> bool:
    """Return whether an error only repeats the errors of the items of a list.

    pydantic calls a list too short if its items have errors.
    """
    return item["type"] == "too_short" and item["ctx"]["actual_length"] != len(item["input"])


class _Explanation(NamedTuple):
    """An error of pydantic in words."""

    rule: str
    location: tuple[int | str, ...]
    value: Any
    is_missing: bool = False
    """True if there is no value to show."""


_Explain = Callable[[ErrorDetails, Any], _Explanation]


def _field_error(item: ErrorDetails, document: Any, expected: Any) -> FieldError:
    explain = _EXPLANATIONS.get(item["type"], _explain_other)
    rule, location, value, is_missing = explain(item, expected)
    # A rule that is broken may be about a field that the document does not have.
    keep_last = is_missing or item["type"] == "broken_rule"
    written = location_as_written(location, document, keep_last=keep_last)
    return FieldError(
        pointer="".join("/" + _pointer_token(part) for part in written),
        rule=rule + unit_of(item, expected),
        value="" if is_missing else _shown(value),
    )


def _explain_other(item: ErrorDetails, _expected: Any) -> _Explanation:
    # pydantic puts this before the messages of our own checks.
    rule = item["msg"].removeprefix("Value error, ")
    return _Explanation(rule, item["loc"], item["input"])


def _explain_missing(item: ErrorDetails, _expected: Any) -> _Explanation:
    return _Explanation("this field is required", item["loc"], None, is_missing=True)


def _explain_extra(item: ErrorDetails, expected: Any) -> _Explanation:
    location = item["loc"]
    known: set[str] = set()
    for model in models_at(expected, location[:-1]):
        known.update(model.model_fields)
    hint = did_you_mean(str(location[-1]), sorted(known)) or "."
    rule = f"there is no such field{hint} Fields: {', '.join(sorted(known))}"
    return _Explanation(rule, location, item["input"])


def _explain_tag(item: ErrorDetails, expected: Any) -> _Explanation:
    """Explain that the field that selects a model of a union is missing or unknown."""
    location = item["loc"]
    value = item["input"]
    tag = item["ctx"]["discriminator"].strip("'")
    known: list[str] = []
    for model in models_at(expected, location):
        if tag in model.model_fields:
            known += literals(model.model_fields[tag].annotation)
    listed = ", ".join(known)
    if not isinstance(value, Mapping):
        return _Explanation(
            f"must be an object with the field {tag}, one of {listed}", location, value
        )
    word = value.get(tag)
    hint = did_you_mean(word, known) if isinstance(word, str) else ""
    is_missing = item["type"] == "union_tag_not_found"
    return _Explanation(f"must be one of {listed}{hint}", (*location, tag), word, is_missing)


def _explain_object(item: ErrorDetails, _expected: Any) -> _Explanation:
    rule = "must be an object"
    if item["loc"][-2:-1] == ("axes",):
        rule = "must be a value, a list of values, or an object with the field type"
    return _Explanation(rule, item["loc"], item["input"])


def _explain_length(item: ErrorDetails, _expected: Any) -> _Explanation:
    rule = f"must have at least {item['ctx']['min_length']} item(s)"
    return _Explanation(rule, item["loc"], item["input"])


def _explain_choice(item: ErrorDetails, _expected: Any) -> _Explanation:
    value = item["input"]
    known = re.findall(r"'([^']*)'", item["ctx"]["expected"])
    hint = did_you_mean(value, known) if isinstance(value, str) else ""
    return _Explanation(f"must be one of {', '.join(known)}{hint}", item["loc"], value)


def _explain_pattern(item: ErrorDetails, _expected: Any) -> _Explanation:
    pattern = item["ctx"]["pattern"]
    rule = PATTERN_RULES.get(pattern, f"must have the form {pattern}")
    # pydantic marks the key of a mapping, as opposed to its value, by a part of the location.
    location = item["loc"]
    if location and location[-1] == "[key]":
        location = location[:-1]
        rule = f"its name {rule}"
    return _Explanation(rule, location, item["input"])


_EXPLANATIONS: Mapping[str, _Explain] = {
    "missing": _explain_missing,
    "extra_forbidden": _explain_extra,
    "union_tag_invalid": _explain_tag,
    "union_tag_not_found": _explain_tag,
    "model_type": _explain_object,
    "model_attributes_type": _explain_object,
    "dict_type": _explain_object,
    "too_short": _explain_length,
    "enum": _explain_choice,
    "literal_error": _explain_choice,
    "string_pattern_mismatch": _explain_pattern,
}
"""How errors of pydantic are explained, by their type."""


def _pointer_token(part: int | str) -> str:
    """Return a part of a location as a token of a JSON pointer [RFC 6901]."""
    return str(part).replace("~", "~0").replace("/", "~1")


def _shown(value: Any) -> str:
    # Values that JSON does not have are named by their type: nobody wants to read a Python repr.
    text = json.dumps(value, default=lambda item: type(item).__name__)
    return text if len(text) <= 200 else text[:197] + "..."
