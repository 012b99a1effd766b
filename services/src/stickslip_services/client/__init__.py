"""The clients of a coordinator, and downloading; they need nothing of the server."""

from stickslip_services.client.aio import AsyncClient
from stickslip_services.client.calls import ClientError, ProblemError, UnexpectedError, UnreachableError
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import pull, verify

__all__ = [
    "AsyncClient",
    "Client",
    "ClientError",
    "ProblemError",
    "UnexpectedError",
    "UnreachableError",
    "pull",
    "verify",
]
