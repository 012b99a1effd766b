"""Errors of the client. Each case that callers tell apart has a class of its own."""

from stickslip_schemas.documents.problems import Problem
from stickslip_schemas.installation import install_hint


class ClientError(Exception):
    """Base of all errors that the client raises."""


class ProblemError(ClientError):
    """The coordinator refused the request; `problem` is its problem document [RFC 9457]."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


class UnreachableError(ClientError):
    """The coordinator does not answer."""


class UnexpectedError(ClientError):
    """The answer is not one of a coordinator of this version."""


class UnsafePathError(ClientError):
    """A manifest names a file outside its dataset, or one that other programs would obey."""


class ForeignFilesError(ClientError):
    """The directory holds files that do not belong to the dataset."""


class DamagedError(ClientError):
    """Received bytes differ from the bytes that the manifest lists."""


class UnsignedError(ClientError):
    """A dataset that must be signed is not."""


class ChangedError(ClientError):
    """A dataset or its signature was changed after it was signed."""


class UnknownSignerError(ClientError):
    """The key that signed a dataset is not that of an allowed signer."""


class SelectionError(ClientError):
    """The dataset has no such array or label, or no sample holds to the conditions."""


class MissingExtraError(ClientError):
    """Packages of an extra are not installed."""

    def __init__(self, extra: str, need: str) -> None:
        super().__init__(f"{need} is not installed: {install_hint('stickslip', extra)}")
