"""The client of a coordinator; it needs nothing of the server."""

from stickslip_services.client.http import Client, ClientError, ProblemError, UnexpectedError, UnreachableError

__all__ = ["Client", "ClientError", "ProblemError", "UnexpectedError", "UnreachableError"]
