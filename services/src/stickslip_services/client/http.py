"""A client of the coordinator: typed answers, problems as exceptions, patience while a coordinator restarts."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any, Self, TypeVar

import httpx
from httpx_sse import EventSource, ServerSentEvent
from stickslip_schemas.base.states import TaskState
from stickslip_schemas.documents.certificate import Certificate, CertificateUpload
from stickslip_schemas.documents.responses import (
    CertificateEntry,
    Dataset,
    DatasetVersion,
    Job,
    JobDetail,
    JobStateEvent,
    Page,
    Preview,
    SampleState,
    TextureEntry,
    Validation,
    WorkerEntry,
)
from stickslip_schemas.format.manifest import Contents, Manifest
from tenacity import Retrying

from stickslip_services.addresses import coordinator_url
from stickslip_services.client import calls
from stickslip_services.client.calls import (
    PATIENCE_SECONDS,
    STREAM_TIMEOUT,
    Call,
    ClientError,
    Event,
    ProblemError,
    UnexpectedError,
    UnreachableError,
    raise_for_problem,
)

__all__ = ["Client", "ClientError", "Event", "ProblemError", "UnexpectedError", "UnreachableError"]

T = TypeVar("T")


class Client:
    """Speaks to one coordinator; use it as a context manager."""

    def __init__(
        self,
        url: str | None = None,
        *,
        key: str | None = None,
        patience: float = PATIENCE_SECONDS,
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Speak to the coordinator at `url`, with an API key.

        Without `url`, it is STICKSLIP_URL or this machine; without `key`, that in STICKSLIP_KEY, if there is one.
        """
        self.url = coordinator_url(url)
        self.patience = patience
        self._sleep = sleep
        self._was_answered = False
        self._http = httpx.Client(**calls.connection_options(self.url, key), transport=transport)

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
        return self._ask(calls.validate(spec))

    def submit(self, spec: Mapping[str, Any], *, idempotency_key: str | None = None, priority: int = 0) -> JobDetail:
        """Submit a job. A request with the same key makes one job however often it is sent; without, a key is made."""
        return self._ask(calls.submit(spec, idempotency_key, priority))

    def upload_texture(self, picture: bytes) -> TextureEntry:
        """Upload a PNG or JPEG file as a texture, for specs to name under `textures`."""
        return self._ask(calls.upload_texture(picture))

    def job(self, job_id: str) -> JobDetail:
        """Return a job."""
        return self._ask(calls.job(job_id))

    def jobs(self) -> Iterator[Job]:
        """Yield all jobs, newest first."""
        return self._items(calls.jobs())

    def samples(self, job_id: str, *, state: TaskState | None = None) -> Iterator[SampleState]:
        """Yield the samples of a job by slot."""
        return self._items(calls.samples(job_id, state))

    def previews(self, job_id: str) -> list[Preview]:
        """Return the previews of a job."""
        return self._ask(calls.previews(job_id))

    def prioritise(self, job_id: str, priority: int) -> JobDetail:
        """Give a job another priority: tasks of the job with the highest number come first."""
        return self._ask(calls.prioritise(job_id, priority))

    def cancel(self, job_id: str) -> JobDetail:
        """Cancel a job."""
        return self._ask(calls.change(job_id, "cancel"))

    def pause(self, job_id: str) -> JobDetail:
        """Pause a job: nothing more is started for it."""
        return self._ask(calls.change(job_id, "pause"))

    def resume(self, job_id: str) -> JobDetail:
        """Let a paused job go on."""
        return self._ask(calls.change(job_id, "resume"))

    def events(self, job_id: str) -> Iterator[Event]:
        """Follow a job until it ends, across lost connections and restarts of the coordinator."""
        last_id = ""
        waited = 0.0
        while True:
            try:
                for message in self._stream(job_id, last_id):
                    waited = 0.0
                    last_id = message.id or last_id
                    event = calls.read_event(message.event, message.data)
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
        path, headers = f"/v1/jobs/{job_id}/events", calls.event_headers(last_id)
        with self._http.stream("GET", path, headers=headers, timeout=STREAM_TIMEOUT) as response:
            if response.status_code == 503:
                raise httpx.ReadError("the coordinator is busy")
            if not response.is_success:
                response.read()
            raise_for_problem(response)
            yield from EventSource(response).iter_sse()

    # --- datasets and workers -------------------------------------------------------------------------------------

    def datasets(self) -> Iterator[Dataset]:
        """Yield all datasets, newest first."""
        return self._items(calls.datasets())

    def dataset(self, dataset: str) -> Dataset:
        """Return a dataset."""
        return self._ask(calls.dataset(dataset))

    def version(self, dataset: str, version: int) -> DatasetVersion:
        """Return a version of a dataset."""
        return self._ask(calls.version(dataset, version))

    def contents(self, dataset: str, version: int) -> Contents:
        """Return what the manifest of a version lists; sections of a large one are asked for when they are needed."""
        root = f"/v1/datasets/{dataset}/versions/{version}/files/"
        manifest, _ = self.manifest(dataset, version)
        return Contents(manifest, lambda file: self.request("GET", root + file.path).content)

    def manifest(self, dataset: str, version: int) -> tuple[Manifest, bytes]:
        """Return the manifest of a version, and its bytes."""
        call = calls.manifest(dataset, version)
        response = self.request(call.method, call.path)
        return call.read(response), response.content

    def workers(self) -> list[WorkerEntry]:
        """Return the workers."""
        return self._ask(calls.workers())

    # --- certificates ---------------------------------------------------------------------------------------------

    def certificates(self) -> Iterator[CertificateEntry]:
        """Yield all certificates, newest first."""
        return self._items(calls.certificates())

    def certificate(self, digest: str) -> Certificate:
        """Return a certificate."""
        return self._ask(calls.certificate(digest))

    def certificate_page(self, digest: str) -> str:
        """Return the page of a certificate, HTML."""
        return self.request("GET", f"/v1/certificates/{digest}/page").text

    def register(self, upload: CertificateUpload) -> CertificateEntry:
        """Register a certificate; sent twice it is there once."""
        return self._ask(calls.register(upload))

    # --- HTTP -----------------------------------------------------------------------------------------------------

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request, again where it did not come through; raise ClientError.

        Every request of this client may be sent twice: what changes something is idempotent or has a key.
        """
        attempts = Retrying(**calls.retry_options(self.patience, lambda: self._was_answered), sleep=self._sleep)
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

    def _ask(self, call: Call[T]) -> T:
        return call.read(self.request(call.method, call.path, **call.options))

    def _items(self, call: Call[Page[T]]) -> Iterator[T]:
        answer: Page[T] | None = None
        while (following := calls.next_page(call, answer)) is not None:
            answer = self._ask(following)
            yield from answer.items
