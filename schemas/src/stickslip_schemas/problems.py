"""Errors as problem documents [RFC 9457] that name the field, the rule and the value."""

import json
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, Field, ValidationError

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
    precondition_failed = "precondition_failed"
    idempotency_key_reused = "idempotency_key_reused"
    kind_not_available = "kind_not_available"
    preset_not_certified = "preset_not_certified"
    stale_lease = "stale_lease"
    unknown_worker = "unknown_worker"
    storage_error = "storage_error"
    busy = "busy"
    too_slow = "too_slow"
    internal_error = "internal_error"


class FieldError(BaseModel):
    """One thing wrong in a document."""

    pointer: str = Field(description="JSON pointer [RFC 6901] into the document as it was sent")
    rule: str = Field(description="the rule that does not hold, in words")
    value: str = Field(description="the offending value as JSON, cut to 200 characters; empty where it is missing")


class Problem(BaseModel):
    """A problem document [RFC 9457]."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    code: ProblemCode
    instance: str | None = None
    request_id: str | None = None
    errors: list[FieldError] = Field(default_factory=list)


def field_errors(error: ValidationError, document: Any) -> list[FieldError]:
    """Return one FieldError for each of pydantic's, with pointers into `document` as the user wrote it."""
    return [
        FieldError(
            pointer=_pointer(item["loc"], document, missing=item["type"] == "missing"),
            rule=item["msg"].removeprefix("Value error, "),
            value="" if item["type"] == "missing" else _shown(item["input"]),
        )
        for item in error.errors(include_url=False)
    ]


def _pointer(location: Sequence[int | str], document: Any, *, missing: bool) -> str:
    """Walk `location` through `document`, leaving out what pydantic put there itself (tags of unions)."""
    parts: list[int | str] = []
    here = document
    for position, part in enumerate(location):
        if isinstance(here, Mapping) and part in here:
            here = here[part]
        elif isinstance(here, list) and isinstance(part, int) and part < len(here):
            here = here[part]
        elif not (missing and position == len(location) - 1):
            continue
        parts.append(part)
    return "".join("/" + str(part).replace("~", "~0").replace("/", "~1") for part in parts)


def _shown(value: Any) -> str:
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = repr(value)
    return text if len(text) <= 200 else text[:197] + "..."
