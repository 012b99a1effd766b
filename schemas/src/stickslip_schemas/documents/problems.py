"""Errors as problem documents [RFC 9457] that name the field, the rule and the value."""

import json
import re
from collections.abc import Mapping, Sequence
from enum import StrEnum
from itertools import islice
from typing import Any

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails

from stickslip_schemas.base import literals, models_at, unit_of
from stickslip_schemas.spec.names import did_you_mean

_NAME_RULE = "must be lower-case letters, digits and '-', 63 at most, the first one no '-'"
PATTERN_RULES = {
    r"^[a-z0-9][a-z0-9-]{0,62}$": _NAME_RULE,
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
"""The rule of each pattern of our documents, in words."""

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
    error: ValidationError, document: Any, of: Any, *, at_most: int | None = None
) -> list[FieldError]:
    """Return one FieldError for each error of pydantic.

    Pointers lead into `document`, as the user wrote it.

    `of` is the type that the document was to be, a model or a union of models: misspelt words are
    compared with its fields and values. This takes time for each error: `at_most` bounds it for a
    document of many.
    """
    items = (item for item in error.errors(include_url=False) if not _is_echo(item))
    return [_field_error(item, document, of) for item in islice(items, at_most)]


def _is_echo(item: ErrorDetails) -> bool:
    """Return whether an error only repeats the errors of the items of a list.

    pydantic calls a list too short if its items have errors.
    """
    return item["type"] == "too_short" and item["ctx"]["actual_length"] != len(item["input"])


def _field_error(item: ErrorDetails, document: Any, of: Any) -> FieldError:
    location, rule = item["loc"], item["msg"].removeprefix("Value error, ")
    value: Any = item["input"]
    is_missing = item["type"] == "missing"
    match item["type"]:
        case "missing":
            rule = "this field is required"
        case "extra_forbidden":
            known = sorted(
                {name for model in models_at(of, location[:-1]) for name in model.model_fields}
            )
            hint = did_you_mean(str(location[-1]), known) or "."
            rule = f"there is no such field{hint} Fields: {', '.join(known)}"
        case "union_tag_invalid" | "union_tag_not_found":
            tag = item["ctx"]["discriminator"].strip("'")
            tags = [
                model.model_fields[tag]
                for model in models_at(of, location)
                if tag in model.model_fields
            ]
            known = [word for field in tags for word in literals(field.annotation)]
            is_missing = item["type"] == "union_tag_not_found" and isinstance(value, Mapping)
            if isinstance(value, Mapping):
                location = (*location, tag)
                value = value.get(tag)
                hint = did_you_mean(str(value), known) if isinstance(value, str) else ""
                rule = f"must be one of {', '.join(known)}{hint}"
            else:
                rule = f"must be an object with the field {tag}, one of {', '.join(known)}"
        case "model_type" | "model_attributes_type" | "dict_type":
            rule = "must be an object"
            if location[-2:-1] == ("axes",):
                rule = "must be a value, a list of values, or an object with the field type"
        case "string_pattern_mismatch":
            pattern = item["ctx"]["pattern"]
            rule = PATTERN_RULES.get(pattern, f"must have the form {pattern}")
        case "too_short":
            rule = f"must have at least {item['ctx']['min_length']} item(s)"
        case "enum" | "literal_error":
            known = re.findall(r"'([^']*)'", item["ctx"]["expected"])
            rule = f"must be one of {', '.join(known)}" + (
                did_you_mean(value, known) if isinstance(value, str) else ""
            )
    rule += unit_of(item, of)
    return FieldError(
        pointer=_pointer(location, document, missing=is_missing or item["type"] == "broken_rule"),
        rule=rule,
        value="" if is_missing else _shown(value),
    )


def _pointer(location: Sequence[int | str], document: Any, *, missing: bool) -> str:
    """Return `location` as a JSON pointer into `document`.

    Parts that pydantic adds itself, such as tags of unions, are left out.
    """
    parts: list[int | str] = []
    here = document
    for position, part in enumerate(location):
        if isinstance(here, Mapping) and part in here:
            here = here[part]
        elif isinstance(here, list) and isinstance(part, int) and part < len(here):
            here = here[part]
        elif not (missing and position == len(location) - 1 and isinstance(here, Mapping | list)):
            continue  # a tag of a union, or the position of the only value of an axis
        parts.append(part)
    return "".join("/" + str(part).replace("~", "~0").replace("/", "~1") for part in parts)


def _shown(value: Any) -> str:
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = repr(value)
    return text if len(text) <= 200 else text[:197] + "..."
