"""A client of the coordinator: typed answers, problems as exceptions, patience while a coordinator restarts."""

import json
import os
import secrets
import ssl
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any, Self, TypeVar

import httpx
from httpx_sse import EventSource, ServerSentEvent
from pydantic import TypeAdapter, ValidationError
from stickslip_schemas.certificate import Certificate, CertificateUpload
from stickslip_schemas.events import (
    DatasetPublishedEvent,
    EventName,
    JobProgressEvent,
    JobStateEvent,
    TaskStateEvent,
)
from stickslip_schemas.manifest import Manifest
from stickslip_schemas.problems import MEDIA_TYPE, Problem
from stickslip_schemas.responses import (
    CertificateEntry,
    Dataset,
    DatasetVersion,
    Job,
    JobDetail,
    Page,
    Preview,
    SampleState,
    Validation,
    WorkerEntry,
)
from stickslip_schemas.states import TaskState
from tenacity import Retrying, retry_if_exception, stop_after_delay, wait_random_exponential

from stickslip_services.addresses import DEFAULT_URL

PATIENCE_SECONDS = 60.0
"""How long a request that did not come through is sent again [s]."""
SILENCE_SECONDS = 60.0
"""How long an event stream may be silent, whose keep-alives come every 15 s, before it is taken for dead [s]."""

T = TypeVar("T")

Event = JobStateEvent | JobProgressEvent | TaskStateEvent | DatasetPublishedEvent

_EVENTS: Mapping[str, type[Event]] = {
    EventName.job_state: JobStateEvent,
    EventName.job_progress: JobProgressEvent,
    EventName.task_state: TaskStateEvent,
    EventName.dataset_published: DatasetPublishedEvent,
}


class ClientError(Exception):
    """Base of what a client may raise.

    ClientError
    ├── ProblemError        the coordinator answered with a problem document
    ├── UnreachableError    it did not answer
    └── UnexpectedError     what answered is not a coordinator of this version
    """


class ProblemError(ClientError):
    """The coordinator refused; `problem` says why."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


class UnreachableError(ClientError):
    """Nobody answers."""


class UnexpectedError(ClientError):
    """The answer makes no sense."""


class Client:
    """Speaks to one coordinator; use it as a context manager."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        key: str | None = None,
        patience: float = PATIENCE_SECONDS,
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Speak to the coordinator at `url`, with an API key: `key`, or else that in STICKSLIP_KEY, if there is one."""
        self.url = url.rstrip("/")
        self.patience = patience
        self._sleep = sleep
        self._was_answered = False
        """A coordinator that has answered once may be restarting; one that never has is not there."""
        key = key or os.environ.get("STICKSLIP_KEY")
        # A proxy of the environment is for the world outside. SSL_CERT_FILE counts: a coordinator's certificate may
        # be of an authority that only this machine trusts.
        authorities = os.environ.get("SSL_CERT_FILE")
        self._http = httpx.Client(
            base_url=self.url,
            timeout=httpx.Timeout(60.0, connect=5.0),
            headers={} if key is None else {"Authorization": f"Bearer {key}"},
            verify=ssl.create_default_context(cafile=authorities) if authorities and url.startswith("https") else True,
            transport=transport,
            trust_env=False,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    # --- jobs -----------------------------------------------------------------------------------------------------

    def validate(self, spec: Mapping[str, Any]) -> Validation:
        """Ask what a job would be."""
        return self._get("POST", "/v1/jobs:validate", Validation, json=spec)

    def submit(self, spec: Mapping[str, Any], *, idempotency_key: str | None = None, priority: int = 0) -> JobDetail:
        """Submit a job. A request with the same key makes one job however often it is sent; without, a key is made."""
        headers = {"Idempotency-Key": idempotency_key or secrets.token_hex(16)}
        query = {"priority": str(priority)} if priority else {}
        return self._get("POST", "/v1/jobs", JobDetail, json=spec, headers=headers, params=query)

    def job(self, job_id: str) -> JobDetail:
        """Return a job."""
        return self._get("GET", f"/v1/jobs/{job_id}", JobDetail)

    def jobs(self) -> Iterator[Job]:
        """Yield all jobs, newest first."""
        return self._items("/v1/jobs", Page[Job])

    def samples(self, job_id: str, *, state: TaskState | None = None) -> Iterator[SampleState]:
        """Yield the samples of a job by slot."""
        query = {} if state is None else {"state": str(state)}
        return self._items(f"/v1/jobs/{job_id}/samples", Page[SampleState], query)

    def previews(self, job_id: str) -> list[Preview]:
        """Return the previews of a job."""
        return self._get("GET", f"/v1/jobs/{job_id}/previews", TypeAdapter(list[Preview]))

    def prioritise(self, job_id: str, priority: int) -> JobDetail:
        """Give a job another priority: tasks of the job with the highest number come first."""
        return self._get("PATCH", f"/v1/jobs/{job_id}", JobDetail, json={"priority": priority})

    def cancel(self, job_id: str) -> JobDetail:
        """Cancel a job."""
        return self._get("POST", f"/v1/jobs/{job_id}:cancel", JobDetail)

    def pause(self, job_id: str) -> JobDetail:
        """Pause a job: nothing more is started for it."""
        return self._get("POST", f"/v1/jobs/{job_id}:pause", JobDetail)

    def resume(self, job_id: str) -> JobDetail:
        """Let a paused job go on."""
        return self._get("POST", f"/v1/jobs/{job_id}:resume", JobDetail)

    def events(self, job_id: str) -> Iterator[Event]:
        """Follow a job until it ends, across lost connections and restarts of the coordinator."""
        last_id = ""
        waited = 0.0
        while True:
            try:
                for message in self._stream(job_id, last_id):
                    waited = 0.0
                    last_id = message.id or last_id
                    event = _event(message.event, message.data)
                    if event is not None:
                        yield event
                    if isinstance(event, JobStateEvent) and event.state.is_terminal:
                        return
                reason = "the event stream ends before the job does"
            except httpx.TransportError as error:
                reason = str(error) or type(error).__name__
            if waited >= self.patience:
                raise UnreachableError(f"{self.url} does not answer: {reason}")
            self._sleep(1.0)
            waited += 1.0

    def _stream(self, job_id: str, last_id: str) -> Iterator[ServerSentEvent]:
        headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": last_id} if last_id else {})
        timeout = httpx.Timeout(SILENCE_SECONDS, connect=5.0)
        with self._http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as response:
            if response.status_code == 503:
                raise httpx.ReadError("the coordinator is busy")
            raise_for_problem(response)
            yield from EventSource(response).iter_sse()

    # --- datasets and workers -------------------------------------------------------------------------------------

    def datasets(self) -> Iterator[Dataset]:
        """Yield all datasets, newest first."""
        return self._items("/v1/datasets", Page[Dataset])

    def dataset(self, dataset: str) -> Dataset:
        """Return a dataset."""
        return self._get("GET", f"/v1/datasets/{dataset}", Dataset)

    def version(self, dataset: str, version: int) -> DatasetVersion:
        """Return a version of a dataset."""
        return self._get("GET", f"/v1/datasets/{dataset}/versions/{version}", DatasetVersion)

    def manifest(self, dataset: str, version: int) -> tuple[Manifest, bytes]:
        """Return the manifest of a version, and its bytes."""
        response = self.request("GET", f"/v1/datasets/{dataset}/versions/{version}/manifest")
        return _parsed(response, Manifest), response.content

    def workers(self) -> list[WorkerEntry]:
        """Return the workers."""
        return self._get("GET", "/v1/workers", TypeAdapter(list[WorkerEntry]))

    # --- certificates ---------------------------------------------------------------------------------------------

    def certificates(self) -> Iterator[CertificateEntry]:
        """Yield all certificates, newest first."""
        return self._items("/v1/certificates", Page[CertificateEntry])

    def certificate(self, digest: str) -> Certificate:
        """Return a certificate."""
        return self._get("GET", f"/v1/certificates/{digest}", Certificate)

    def certificate_page(self, digest: str) -> str:
        """Return the page of a certificate, HTML."""
        return self.request("GET", f"/v1/certificates/{digest}/page").text

    def register(self, upload: CertificateUpload) -> CertificateEntry:
        """Register a certificate; sent twice it is there once."""
        content, headers = upload.model_dump_json(), {"Content-Type": "application/json"}
        return self._get("POST", "/v1/certificates", CertificateEntry, content=content, headers=headers)

    # --- HTTP -----------------------------------------------------------------------------------------------------

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request, again where it did not come through; raise ClientError.

        Every request of this client may be sent twice: what changes something is idempotent or has a key.
        """
        attempts = Retrying(
            retry=retry_if_exception(self._is_passing),
            wait=wait_random_exponential(multiplier=0.25, max=3),
            stop=stop_after_delay(self.patience),
            sleep=self._sleep,
            reraise=True,
        )
        try:
            return attempts(self._send, method, path, **options)
        except httpx.TransportError as error:
            raise UnreachableError(f"{self.url} does not answer: {error or type(error).__name__}") from error
        except httpx.HTTPStatusError as error:
            raise_for_problem(error.response)
            raise UnexpectedError(f"{self.url} answered with status {error.response.status_code}") from error

    def stream(self, path: str, headers: Mapping[str, str]) -> AbstractContextManager[httpx.Response]:
        """Open a download; the caller handles errors of the connection."""
        return self._http.stream("GET", path, headers=headers)

    def _send(self, method: str, path: str, **options: Any) -> httpx.Response:
        response = self._http.request(method, path, **options)
        self._was_answered = True
        if response.status_code == 503:
            response.raise_for_status()
        raise_for_problem(response)
        return response

    def _is_passing(self, error: BaseException) -> bool:
        """Tell whether an error may be gone in a moment."""
        if isinstance(error, httpx.ConnectError) and not self._was_answered:
            return False
        return isinstance(error, httpx.TransportError | httpx.HTTPStatusError)

    def _get(self, method: str, path: str, model: type[T] | TypeAdapter[T], **options: Any) -> T:
        return _parsed(self.request(method, path, **options), model)

    def _items(self, path: str, page: type[Page[T]], query: Mapping[str, str] | None = None) -> Iterator[T]:
        parameters = {"page_size": "200", **(query or {})}
        while True:
            answer = self._get("GET", path, page, params=parameters)
            yield from answer.items
            if answer.next_page_token is None:
                return
            parameters["page_token"] = answer.next_page_token


def raise_for_problem(response: httpx.Response) -> None:
    """Raise ProblemError or UnexpectedError where the coordinator did not do what it was asked for."""
    if response.is_success:
        return
    response.read()
    if response.headers.get("content-type", "").startswith(MEDIA_TYPE):
        try:
            problem = Problem.model_validate_json(response.content)
        except ValidationError as error:
            raise UnexpectedError(f"{response.url} answered with a problem that is none") from error
        raise ProblemError(problem)
    raise UnexpectedError(f"{response.url} answered with status {response.status_code}; is it a coordinator?")


def _parsed(response: httpx.Response, model: type[T] | TypeAdapter[T]) -> T:
    adapter = model if isinstance(model, TypeAdapter) else TypeAdapter(model)
    try:
        return adapter.validate_json(response.content)
    except ValidationError as error:
        raise UnexpectedError(f"{response.url} answered with something else than expected: {error}") from error


def _event(name: str, data: str) -> Event | None:
    """Return an event, or None where a newer coordinator tells something that this version does not know."""
    model = _EVENTS.get(name)
    if model is None:
        return None
    try:
        return model.model_validate(json.loads(data))
    except ValueError as error:
        raise UnexpectedError(f"the event {name} holds something else than expected: {error}") from error
