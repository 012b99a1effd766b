"""Errors as problem documents [RFC 9457] that name the field, the rule and the value."""

import json
from enum import StrEnum
from itertools import islice, takewhile
from typing import Any

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails

from stickslip_schemas.base import location_as_written
from stickslip_schemas.spec.explanations import explain

MEDIA_TYPE = "application/problem+json"


class ProblemCode(StrEnum):
    """The sort of a problem, for programs."""

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


SHOWN_LETTERS = 200
"""Letters of a wrong value that a message shows."""


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


def _field_error(item: ErrorDetails, document: Any, expected: Any) -> FieldError:
    rule, location, value, is_missing = explain(item, expected)
    # A rule that is broken may be about a field that the document does not have.
    keep_last = is_missing or item["type"] == "broken_rule"
    written = location_as_written(location, document, keep_last=keep_last)
    return FieldError(
        pointer="".join("/" + _pointer_token(part) for part in written),
        rule=rule,
        value="" if is_missing else _short_repr(value),
    )


def _pointer_token(part: int | str) -> str:
    """Return a part of a location as a token of a JSON pointer [RFC 6901]."""
    return str(part).replace("~", "~0").replace("/", "~1")


def _short_repr(value: Any) -> str:
    # Values that JSON does not have are named by their type: nobody wants to read a Python repr.
    text = json.dumps(_beginning(value, [SHOWN_LETTERS]), default=lambda item: type(item).__name__)
    return text if len(text) <= SHOWN_LETTERS else text[: SHOWN_LETTERS - 3] + "..."


def _beginning(value: Any, values_left: list[int]) -> Any:
    """Return a value without the parts that are not shown: it may have millions of them.

    Each part takes a letter or more, so as many parts as letters are enough; `values_left` counts
    them down.
    """
    values_left[0] -= 1
    if isinstance(value, str):
        return value[: SHOWN_LETTERS + 1]
    if isinstance(value, dict):
        return {
            name: _beginning(item, values_left)
            for name, item in takewhile(lambda _: values_left[0] >= 0, value.items())
        }
    if isinstance(value, list | tuple):
        return [
            _beginning(item, values_left)
            for item in takewhile(lambda _: values_left[0] >= 0, value)
        ]
    return value
