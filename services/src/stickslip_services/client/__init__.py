"""The client of a coordinator, and downloads. It needs no package of the server."""

from stickslip_services.client.errors import (
    ClientError,
    ProblemError,
    UnexpectedError,
    UnreachableError,
)
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import pull
from stickslip_services.client.signing import signer_of
from stickslip_services.client.verifying import verify

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
