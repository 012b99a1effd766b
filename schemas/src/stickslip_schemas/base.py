"""The base of all documents: strict numbers, content keys, states, reasons and units."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails


def _whole(value: Any) -> Any:
    """Return 1 for 1.0, which is the same number in JSON."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


WHOLE = BeforeValidator(_whole)
"""For integers with bounds of their own: stands after them, or the bounds are not in the JSON
schema.
"""
Int = Annotated[int, Strict(), WHOLE]
"""A whole number: not the text "1", not true."""
Float = Annotated[float, Strict()]
"""A number: not the text "1", not true."""
Bool = Annotated[bool, Strict()]
"""True or false: not 1, not "yes"."""


class Document(BaseModel):
    """Refuse unknown fields, NaN and infinities; never change after construction."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


KEY_PATTERN = r"^[0-9a-f]{64}$"

Sha256 = Annotated[
    str, Field(pattern=KEY_PATTERN, description="SHA-256, 64 lower-case hexadecimal digits")
]


def canonical_json(value: Any) -> str:
    """Return the canonical JSON text of `value`.

    Keys are sorted, there are no spaces, floats have the shortest text that reads back as the same
    number, and -0.0 is written as 0.0.

    NaN and infinities raise ValueError, for they have no JSON form.
    """
    # Two documents are equal exactly if these texts are, so the text can stand for the document.
    return json.dumps(_normalised(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def content_key(purpose: str, value: Any) -> str:
    """Return the SHA-256 of `value` and `purpose`.

    The purpose keeps two sorts of things from ever sharing a key.
    """
    return sha256(keyed_text(purpose, canonical_json(value)).encode())


def keyed_text(purpose: str, canonical: str) -> str:
    """Return the text that is hashed for the content key of a value.

    `canonical` is the canonical JSON of the value.
    """
    return f"stickslip/{purpose}\n{canonical}"


def derived_seed(seed: int, purpose: str, value: Any) -> int:
    """Return a seed in [0, 2**31) that depends on `seed`, `purpose` and `value`.

    It never depends on a position in a grid, so a larger grid leaves the seeds of its samples
    alone.
    """
    return seed_of_key(content_key(f"seed/{purpose}", {"seed": seed, "for": value}))


def seed_of_key(key: str) -> int:
    """Return the seed in [0, 2**31) that a content key gives."""
    # 15 hexadecimal digits are 60 bits: enough for every remainder to be equally likely.
    return int(key[:15], 16) % 2**31


def sha256(data: bytes) -> str:
    """Return the SHA-256 of `data` in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def is_sha256(text: str) -> bool:
    """Return whether `text` has the form of a SHA-256 in lower-case hexadecimal."""
    return re.fullmatch(KEY_PATTERN, text) is not None


ARTIFACT = "sha256:"
"""Prefix of a reference to an artifact, which a name cannot have."""

ArtifactRef = Annotated[
    str,
    Field(pattern=r"^sha256:[0-9a-f]{64}$", description="`sha256:` and the SHA-256 of an artifact"),
]


def artifact_digest(name: str) -> Sha256 | None:
    """Return the digest that a reference to an artifact names; None of a name."""
    return name.removeprefix(ARTIFACT) if name.startswith(ARTIFACT) else None


def replace_at(document: Any, place: Sequence[str | int], value: Any) -> Any:
    """Return a copy of a JSON document with another value at a place.

    Positions in lists may be texts.
    """
    if not place:
        return value
    step, *rest = place
    # Only the lists and mappings along the location are copied; the rest is shared.
    if isinstance(document, list):
        items = list(document)
        items[int(step)] = replace_at(items[int(step)], rest, value)
        return items
    return {**document, step: replace_at(document[step], rest, value)}


def _normalised(value: Any) -> Any:
    if isinstance(value, float):
        return value + 0.0  # -0.0 + 0.0 is 0.0
    if isinstance(value, dict):
        return {key: _normalised(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_normalised(item) for item in value]
    return value


class JobState(StrEnum):
    """State of a job; `pausing` and `cancelling` last until all leased tasks are returned.

    A job of many samples is `planning` until all its tasks are written; the first of them run
    meanwhile.
    """

    planning = "planning"
    queued = "queued"
    running = "running"
    pausing = "pausing"
    paused = "paused"
    cancelling = "cancelling"
    cancelled = "cancelled"
    succeeded = "succeeded"
    succeeded_with_rejects = "succeeded_with_rejects"
    failed = "failed"

    @property
    def is_open(self) -> bool:
        """True until the job has ended."""
        ended = (
            JobState.cancelled,
            JobState.succeeded,
            JobState.succeeded_with_rejects,
            JobState.failed,
        )
        return self not in ended


class TaskState(StrEnum):
    """State of a task; `soft_failed` waits for another try, `rejected` is a result."""

    pending = "pending"
    leased = "leased"
    running = "running"
    succeeded = "succeeded"
    soft_failed = "soft_failed"
    failed = "failed"
    rejected = "rejected"
    cancelled = "cancelled"

    @property
    def is_settled(self) -> bool:
        """True if the task has a result that others may use."""
        return self in (TaskState.succeeded, TaskState.rejected)

    @property
    def is_over(self) -> bool:
        return self.is_settled or self in (TaskState.failed, TaskState.cancelled)


class Stage(StrEnum):
    """Steps of the pipeline, in order."""

    simulate = "simulate"
    render = "render"
    pack = "pack"
    publish = "publish"


class Reason(StrEnum):
    """Why a job or task ended, or why it waits."""

    # Infrastructure. Another try may succeed, so these are retried.
    exec_timeout = "exec_timeout"
    worker_lost = "worker_lost"
    oom_killed = "oom_killed"
    renderer_crash = "renderer_crash"
    process_crash = "process_crash"
    storage_error = "storage_error"
    store_unavailable = "store_unavailable"
    internal_error = "internal_error"
    # The sample itself. These are deterministic, so they are never retried.
    impossible_start = "impossible_start"
    solver_diverged = "solver_diverged"
    out_of_frame = "out_of_frame"
    invalid_sample = "invalid_sample"
    poor_pictures = "poor_pictures"
    # The same, of cloth: the names are those of the solver's checks.
    not_finite = "not_finite"
    jumps = "jumps"
    unconverged = "unconverged"
    budget = "budget"
    crossings = "crossings"
    contact_gain = "contact_gain"
    stretch = "stretch"
    penetration = "penetration"
    passages = "passages"
    friction_error = "friction_error"
    step_error = "step_error"
    # Only jobs end or wait for these.
    cancelled = "cancelled"
    failed_tasks = "failed_tasks"
    quarantined = "quarantined"
    waiting_for_worker = "waiting_for_worker"
    preset_not_certified = "preset_not_certified"
    damaged_row = "damaged_row"
    no_valid_samples = "no_valid_samples"

    @property
    def ends_a_process(self) -> bool:
        """True if the process of the task ended with it.

        One that does so again and again is quarantined.
        """
        return self in _ENDING

    @property
    def is_deterministic(self) -> bool:
        """True if a second try gives the same answer.

        The sample is then rejected and not retried.
        """
        return self not in _INFRASTRUCTURE | _OF_JOBS


_ENDING = {
    Reason.exec_timeout,
    Reason.worker_lost,
    Reason.oom_killed,
    Reason.renderer_crash,
    Reason.process_crash,
}
_INFRASTRUCTURE = {*_ENDING, Reason.storage_error, Reason.store_unavailable, Reason.internal_error}
_OF_JOBS = {
    Reason.cancelled,
    Reason.failed_tasks,
    Reason.quarantined,
    Reason.waiting_for_worker,
    Reason.preset_not_certified,
    Reason.damaged_row,
    Reason.no_valid_samples,
}


def location_as_written(
    location: Sequence[int | str], document: Any, *, keep_last: bool = False
) -> tuple[int | str, ...]:
    """Return a location of pydantic without parts that the document does not have.

    pydantic adds parts itself, such as tags of unions and positions in a list that was written
    as one value. `keep_last` keeps the last part if it is a field or an item that the document
    lacks.
    """
    written: list[int | str] = []
    value = document
    for depth, part in enumerate(location):
        is_last = depth == len(location) - 1
        if isinstance(value, Mapping) and part in value:
            value = value[part]
        elif isinstance(value, list | tuple) and isinstance(part, int) and part < len(value):
            value = value[part]
        # A scalar has no parts, so nothing of it can be missing.
        elif not (is_last and keep_last and isinstance(value, Mapping | list | tuple)):
            continue
        written.append(part)
    return tuple(written)


_NUMBER_RULES = (
    "greater_than",
    "greater_than_equal",
    "less_than",
    "less_than_equal",
    "float_type",
    "finite_number",
)
"""Types of pydantic's errors that are about a number."""


def unit_of(item: ErrorDetails, expected: Any) -> str:
    """Return ` [unit]` of the number that an error is about, or an empty text.

    `expected` is the type of the whole document, a model or a union of models.
    """
    if item["type"] not in _NUMBER_RULES:
        return ""
    location = item["loc"]
    names = [depth for depth, part in enumerate(location) if isinstance(part, str)]
    # The innermost name is a field, unless it is the tag of a union or a key of a mapping.
    for depth in reversed(names):
        for model in models_at(expected, location[:depth]):
            field = model.model_fields.get(str(location[depth]))
            if field is not None:
                unit = _field_unit(field)
                return f" [{unit}]" if unit else ""
    return ""


def unit_in(document: Any, location: Sequence[int | str]) -> str:
    """Return the unit of the number at a location in a document; `1` of a pure number."""
    unit = ""
    for part in location:
        if isinstance(document, BaseModel):
            unit = _field_unit(type(document).model_fields[str(part)])
            document = getattr(document, str(part))
        else:
            document = document[part]
    return unit or "1"


def _field_unit(field: FieldInfo) -> str:
    # Descriptions of numbers have their unit in brackets, for example "length [m]".
    unit = re.search(r"\[([^\]]+)\]", field.description or "")
    return unit[1] if unit else ""


def models_at(expected: Any, location: Sequence[int | str]) -> list[type[BaseModel]]:
    """Return the models that a location in a document may hold, from the type of the whole."""
    models = list(_models_in(expected))
    for part in location:
        annotations = [
            model.model_fields[part].annotation for model in models if part in model.model_fields
        ]
        if annotations:
            # A field: go on with the models that its value may be.
            models = []
            for annotation in annotations:
                models += _models_in(annotation)
        else:
            # A position in a list keeps all models; the tag of a union selects one of them.
            models = [model for model in models if _has_tag(model, part)] or models
    return models


def _has_tag(model: type[BaseModel], tag: int | str) -> bool:
    """Return whether a model is the member of a union that a tag selects."""
    return any(tag in literals(field.annotation) for field in model.model_fields.values())


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif get_origin(annotation) is not Literal:
        for argument in get_args(annotation):
            yield from _models_in(argument)


def literals(annotation: Any) -> list[str]:
    """Return the values of a `Literal` as texts; none of any other annotation."""
    if get_origin(annotation) is not Literal:
        return []
    return [str(value) for value in get_args(annotation)]
