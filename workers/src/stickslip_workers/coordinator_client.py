"""The coordinator as the dispatcher sees it: four questions over HTTP."""

import ssl
from pathlib import Path
from typing import TypeVar

import httpx
from pydantic import BaseModel
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    LeaseBatch,
    LeaseRequest,
    ReportAnswer,
    ReportBatch,
    WorkerRegistration,
    WorkerSession,
)

Answer = TypeVar("Answer", bound=BaseModel)

PROMPT = httpx.Timeout(30, connect=5)
PATIENT = httpx.Timeout(300, connect=5)
"""For a lease and a report: of a version of a million samples, the coordinator lists or looks for all the files."""


class CoordinatorError(Exception):
    """The coordinator did not do what it was asked."""


class UnreachableError(CoordinatorError):
    """No answer, or one that says: later."""


class UnknownWorkerError(CoordinatorError):
    """The coordinator does not know the session (any more): register again."""


class SupersededError(CoordinatorError):
    """A newer dispatcher has registered under the same name: this one has to go."""


class RefusedError(CoordinatorError):
    """A request that will be refused every time."""


def pinned(certificate: Path) -> ssl.SSLContext:
    """Return a context that trusts a server with this very certificate, by whatever name it is reached."""
    context = ssl.create_default_context(cafile=str(certificate))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


class CoordinatorClient:
    """A client, for any number of threads."""

    def __init__(self, url: str, key: str | None = None, tls_certificate: Path | None = None) -> None:
        # A proxy of the environment is for the world outside, not for a service beside this one.
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        verify = True if tls_certificate is None else pinned(tls_certificate)
        self._http = httpx.Client(base_url=url.rstrip("/"), headers=headers, verify=verify, trust_env=False)

    def register(self, registration: WorkerRegistration) -> WorkerSession:
        """Present the dispatcher."""
        return self._post("/v1/workers", registration, WorkerSession)

    def lease(self, request: LeaseRequest) -> LeaseBatch:
        """Ask for tasks."""
        return self._post("/v1/worker/lease", request, LeaseBatch, timeout=PATIENT)

    def heartbeat(self, heartbeat: Heartbeat) -> HeartbeatAnswer:
        """Renew leases."""
        return self._post("/v1/worker/heartbeat", heartbeat, HeartbeatAnswer)

    def report(self, reports: ReportBatch) -> ReportAnswer:
        """Report results."""
        return self._post("/v1/worker/report", reports, ReportAnswer, timeout=PATIENT)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def _post(self, path: str, document: BaseModel, answer: type[Answer], *, timeout: httpx.Timeout = PROMPT) -> Answer:
        try:
            response = self._http.post(
                path,
                content=document.model_dump_json(),
                headers={"Content-Type": "application/json"},
                timeout=timeout,
            )
        except httpx.TransportError as error:
            raise UnreachableError(f"{path}: {type(error).__name__}: {error}") from error
        if response.status_code >= 500 or response.status_code == 429:
            raise UnreachableError(f"{path}: {response.status_code} {response.text[:500]}")
        if response.is_success:
            return answer.model_validate_json(response.content)
        kind = _ERRORS.get(_problem_code(response), RefusedError)
        raise kind(f"{path}: {response.status_code} {response.text[:500]}")


_ERRORS: dict[str | None, type[CoordinatorError]] = {
    ProblemCode.unknown_worker: UnknownWorkerError,
    ProblemCode.conflict: SupersededError,
}


def _problem_code(response: httpx.Response) -> str | None:
    try:
        return str(response.json()["code"])
    except (ValueError, KeyError, TypeError):
        return None
