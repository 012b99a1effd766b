"""The client of a coordinator, and downloads. It needs no package of the server."""

from stickslip_services.client.http import (
    Client,
    ClientError,
    ProblemError,
    UnexpectedError,
    UnreachableError,
)
from stickslip_services.client.pulling import pull
from stickslip_services.client.verifying import signer_of, verify

__all__ = [
    "Client",
    "ClientError",
    "ProblemError",
    "UnexpectedError",
    "UnreachableError",
    "pull",
    "signer_of",
    "verify",
]
