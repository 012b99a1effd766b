"""What may go wrong when a request is perfectly well-formed. api/problems.py turns each into a problem document.

StickslipError
├── NotFoundError               404
├── UnknownWorkerError          404
├── ConflictError               409
├── IdempotencyKeyReusedError   422
├── KindNotAvailableError       422
├── PresetNotCertifiedError     422
└── MissingArtifactError        500
"""


class StickslipError(Exception):
    """Base of the errors of the coordinator."""


class NotFoundError(StickslipError):
    """There is no such thing."""


class ConflictError(StickslipError):
    """It cannot be done in the state that the thing is in."""


class IdempotencyKeyReusedError(StickslipError):
    """The key came with another document before."""


class KindNotAvailableError(StickslipError):
    """No worker makes this kind."""


class PresetNotCertifiedError(StickslipError):
    """No certificate vouches for the preset with the workers' build."""

    def __init__(self, preset: str, sim_core: str) -> None:
        self.preset = preset
        self.rule = (
            f"the preset needs a passing certificate for the workers' sim_core build {sim_core[:12]}: run `stickslip "
            f"certify --preset {preset}` with that build, or say `allow_uncertified: true` in the spec"
        )
        super().__init__(f"preset {preset!r} is not certified: {self.rule}")


class UnknownWorkerError(StickslipError):
    """No worker has registered under this id."""


class MissingArtifactError(StickslipError):
    """The store does not have what the database says it has, or not all of it."""


class DatabaseRefusedError(Exception):
    """The database is damaged, lost, or of another version; the message says what to do."""


class SupervisorError(Exception):
    """`stickslip up` cannot go on."""


class ServerNotInstalledError(Exception):
    """A server command was called where only the client is installed."""
