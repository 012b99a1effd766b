"""Errors of well-formed requests, and of commands.

`api/problems.py` maps those of requests to problem documents.
"""

import json
from collections.abc import Sequence

from stickslip_schemas.documents.problems import FieldError


class StickslipError(Exception):
    """Base of the errors of the coordinator.

    `fields` are the fields of the request that break a rule.
    """

    fields: Sequence[FieldError] = ()


class NotFoundError(StickslipError):
    """The requested thing does not exist."""


class InvalidKeyError(StickslipError):
    """The key of a request is unknown, was revoked, or has expired."""


class ConflictError(StickslipError):
    """The state of the thing does not allow the request."""


class IdempotencyKeyReusedError(StickslipError):
    """The idempotency key was used with another document."""


class KindNotAvailableError(StickslipError):
    """No worker makes this kind."""


class PresetNotCertifiedError(StickslipError):
    """The preset has no passing certificate for the workers' build."""

    def __init__(self, preset: str, sim_core: str, missing: Sequence[str] = ()) -> None:
        rule = (
            f"run `stickslip certify --preset {preset}` with the workers' build {sim_core[:12]} "
            "(a few minutes; quick certificates do not count), or write "
            "`allow_uncertified: true` in the spec"
        )
        if missing:
            rule = (
                f"it must have {', '.join(missing)}, since cloth touches cloth: {rule}. "
                "Certificates of the thesis's presets have no protocols of contact: take another "
                "preset, or in a spec of `cloth_drag` write `self_friction: null`"
            )
        self.fields = [FieldError(pointer="/preset", rule=rule, value=json.dumps(preset))]
        super().__init__(f"preset {preset!r} has no passing certificate: {rule}")


class QuotaExceededError(StickslipError):
    """A job would exceed the quota of its project."""

    def __init__(
        self, project: str, quantity: str, limit: int, *, used: int, requested: int
    ) -> None:
        value = used + requested
        owner = f"the project {project!r}" if project else "requests without a project"
        rule = f"{quantity} of {owner} that have not ended must be at most {limit}"
        self.fields = [FieldError(pointer="", rule=rule, value=str(value))]
        super().__init__(
            f"{rule}: there are {used}, and with the {requested} of this job there would be "
            f"{value}. Wait until some of them have ended, or cancel some"
        )


class UnknownFileError(StickslipError):
    """A spec names files that are not in the store, or that it cannot use."""

    def __init__(self, fields: list[FieldError]) -> None:
        self.fields = fields
        super().__init__("; ".join(f"{field.pointer}: {field.rule}" for field in fields[:3]))


class UnknownWorkerError(StickslipError):
    """No worker has registered under this id."""


class DamagedRowError(StickslipError):
    """A row of the database has other values than were written.

    `results` are the tasks whose results are damaged, by `seq`.
    """

    def __init__(self, row: str, results: Sequence[int] = ()) -> None:
        self.row = row
        self.results = results
        super().__init__(
            f"{row} is damaged in the database. Restore a backup of the database, or submit the "
            "spec again: results that are whole are kept"
        )


class CommandError(Exception):
    """Base of errors that a command prints in one sentence, without a traceback."""


class DatabaseRefusedError(CommandError):
    """The database is damaged, lost, or of another version; the message says what to do."""


class SettingsError(CommandError):
    """A setting breaks a rule."""
