"""What may go wrong when a request is perfectly well-formed. api/problems.py turns each into a problem document.

StickslipError
├── NotFoundError               404
├── UnknownWorkerError          404
├── ConflictError               409
├── PreconditionFailedError     412
├── QuotaExceededError          429
├── IdempotencyKeyReusedError   422
├── KindNotAvailableError       409
├── PresetNotCertifiedError     409
├── UnknownTextureError         422
└── MissingArtifactError        500
"""

from collections.abc import Sequence

from stickslip_schemas.documents.problems import FieldError


class StickslipError(Exception):
    """Base of the errors of the coordinator."""


class NotFoundError(StickslipError):
    """There is no such thing."""


class ConflictError(StickslipError):
    """The state does not allow it."""


class PreconditionFailedError(StickslipError):
    """The thing has changed since the client saw it."""


class IdempotencyKeyReusedError(StickslipError):
    """The key came with another document before."""


class KindNotAvailableError(StickslipError):
    """No worker makes this kind."""


class PresetNotCertifiedError(StickslipError):
    """No certificate vouches for the preset with the workers' build."""

    def __init__(self, preset: str, sim_core: str, missing: Sequence[str] = ()) -> None:
        self.preset = preset
        self.rule = (
            f"run `stickslip certify --preset {preset}` with the workers' build {sim_core[:12]} (a few minutes; quick "
            "certificates do not count), or write `allow_uncertified: true` in the spec"
        )
        if missing:
            self.rule = (
                f"it must have {', '.join(missing)}, since cloth touches cloth: {self.rule}. Certificates of the "
                "thesis's presets have no protocols of contact: take another preset, or in a spec of `cloth_drag` "
                "write `self_friction: null`"
            )
        super().__init__(f"preset {preset!r} has no passing certificate: {self.rule}")


class QuotaExceededError(StickslipError):
    """A project has as many jobs or samples as it may have."""

    def __init__(self, project: str, what: str, limit: int, *, taken: int, asked: int) -> None:
        self.value = taken + asked
        whose = f"the project {project!r}" if project else "requests without a project"
        self.rule = f"{what} of {whose} that have not ended must be at most {limit}"
        super().__init__(
            f"{self.rule}: there are {taken}, and with the {asked} of this job there would be {self.value}. Wait until "
            "some of them have ended, or cancel some"
        )


class UnknownTextureError(StickslipError):
    """A spec names textures that are not in the store."""

    def __init__(self, fields: list[FieldError]) -> None:
        self.fields = fields
        super().__init__("; ".join(f"{field.pointer}: {field.rule}" for field in fields[:3]))


class UnknownWorkerError(StickslipError):
    """No worker has registered under this id."""


class MissingArtifactError(StickslipError):
    """The store does not have what the database says it has, or not all of it."""


class CommandError(Exception):
    """Base of errors that a command prints in one sentence, without a traceback."""


class DatabaseRefusedError(CommandError):
    """The database is damaged, lost, or of another version; the message says what to do."""


class SettingsError(CommandError):
    """A setting breaks a rule."""


class SupervisorError(CommandError):
    """`stickslip up` cannot go on."""


class ServerNotInstalledError(CommandError):
    """A server command was called where only the client is installed."""
