"""Errors of the client: a `ClientError` of a class of its own for each case that callers tell apart."""

import httpx
from pydantic import ValidationError
from stickslip_schemas.documents.problems import MEDIA_TYPE, Problem


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
    """A manifest names a file outside its dataset."""


class ForeignFilesError(ClientError):
    """The directory holds files that do not belong to the dataset."""


class DamagedError(ClientError):
    """Received bytes differ from what the manifest lists."""


class UnsignedError(ClientError):
    """A dataset that must be signed is not."""


class ChangedError(ClientError):
    """A dataset or its signature was changed after it was signed."""


class UnknownSignerError(ClientError):
    """The key that signed a dataset is not that of an allowed signer."""


class SelectionError(ClientError):
    """The dataset has no such array or label."""


class MissingExtraError(ClientError):
    """Packages of an extra are not installed."""

    def __init__(self, extra: str, what: str) -> None:
        super().__init__(f"{what} is not installed: pip install 'stickslip[{extra}]'")


def raise_for_problem(response: httpx.Response) -> None:
    """Raise ProblemError or UnexpectedError unless a response, whose body has been read, reports success."""
    if response.is_success:
        return
    if response.headers.get("content-type", "").startswith(MEDIA_TYPE):
        try:
            problem = Problem.model_validate_json(response.content)
        except ValidationError as error:
            raise UnexpectedError(f"{response.url} answered with an invalid problem document") from error
        raise ProblemError(problem)
    raise UnexpectedError(f"{response.url} answered with status {response.status_code}; is it a coordinator?")
