"""The asynchronous client: the same calls, answers and errors as `Client`, with `await`."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
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
from tenacity import AsyncRetrying

from stickslip_services.addresses import coordinator_url
from stickslip_services.client import calls
from stickslip_services.client.calls import (
    PATIENCE_SECONDS,
    STREAM_TIMEOUT,
    Call,
    Event,
    UnexpectedError,
    UnreachableError,
    raise_for_problem,
)
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import Pulled, pull

T = TypeVar("T")


class AsyncClient:
    """Speaks to one coordinator; use it as an asynchronous context manager."""

    def __init__(
        self,
        url: str | None = None,
        *,
        key: str | None = None,
        patience: float = PATIENCE_SECONDS,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        """Speak to the coordinator at `url`, with an API key.

        Without `url`, it is STICKSLIP_URL or this machine; without `key`, that in STICKSLIP_KEY, if there is one.
        """
        self.url = coordinator_url(url)
        self.patience = patience
        self._key = key
        self._was_answered = False
        self._http = httpx.AsyncClient(**calls.connection_options(self.url, key), transport=transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    # --- jobs -----------------------------------------------------------------------------------------------------

    async def validate(self, spec: Mapping[str, Any]) -> Validation:
        """Ask what a job would be."""
        return await self._ask(calls.validate(spec))

    async def submit(
        self, spec: Mapping[str, Any], *, idempotency_key: str | None = None, priority: int = 0
    ) -> JobDetail:
        """Submit a job. A request with the same key makes one job however often it is sent; without, a key is made."""
        return await self._ask(calls.submit(spec, idempotency_key, priority))

    async def upload_texture(self, picture: bytes) -> TextureEntry:
        """Upload a PNG or JPEG file as a texture, for specs to name under `textures`."""
        return await self._ask(calls.upload_texture(picture))

    async def job(self, job_id: str) -> JobDetail:
        """Return a job."""
        return await self._ask(calls.job(job_id))

    def jobs(self) -> AsyncIterator[Job]:
        """Yield all jobs, newest first."""
        return self._items(calls.jobs())

    def samples(self, job_id: str, *, state: TaskState | None = None) -> AsyncIterator[SampleState]:
        """Yield the samples of a job by slot."""
        return self._items(calls.samples(job_id, state))

    async def previews(self, job_id: str) -> list[Preview]:
        """Return the previews of a job."""
        return await self._ask(calls.previews(job_id))

    async def prioritise(self, job_id: str, priority: int) -> JobDetail:
        """Give a job another priority: tasks of the job with the highest number come first."""
        return await self._ask(calls.prioritise(job_id, priority))

    async def cancel(self, job_id: str) -> JobDetail:
        """Cancel a job."""
        return await self._ask(calls.change(job_id, "cancel"))

    async def pause(self, job_id: str) -> JobDetail:
        """Pause a job: nothing more is started for it."""
        return await self._ask(calls.change(job_id, "pause"))

    async def resume(self, job_id: str) -> JobDetail:
        """Let a paused job go on."""
        return await self._ask(calls.change(job_id, "resume"))

    async def events(self, job_id: str) -> AsyncIterator[Event]:
        """Follow a job until it ends, across lost connections and restarts of the coordinator."""
        last_id = ""
        waited = 0.0
        while True:
            try:
                async for message in self._stream(job_id, last_id):
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
            await asyncio.sleep(1.0)
            waited += 1.0

    async def _stream(self, job_id: str, last_id: str) -> AsyncIterator[ServerSentEvent]:
        path, headers = f"/v1/jobs/{job_id}/events", calls.event_headers(last_id)
        async with self._http.stream("GET", path, headers=headers, timeout=STREAM_TIMEOUT) as response:
            if response.status_code == 503:
                raise httpx.ReadError("the coordinator is busy")
            if not response.is_success:
                await response.aread()
            raise_for_problem(response)
            async for message in EventSource(response).aiter_sse():
                yield message

    # --- datasets and workers -------------------------------------------------------------------------------------

    def datasets(self) -> AsyncIterator[Dataset]:
        """Yield all datasets, newest first."""
        return self._items(calls.datasets())

    async def dataset(self, dataset: str) -> Dataset:
        """Return a dataset."""
        return await self._ask(calls.dataset(dataset))

    async def version(self, dataset: str, version: int) -> DatasetVersion:
        """Return a version of a dataset."""
        return await self._ask(calls.version(dataset, version))

    async def manifest(self, dataset: str, version: int) -> Manifest:
        """Return the manifest of a version."""
        return await self._ask(calls.manifest(dataset, version))

    async def contents(self, dataset: str, version: int) -> Contents:
        """Return what the manifest of a version lists; the sections of a large one are all read first."""

        def read() -> Contents:
            with Client(self.url, key=self._key, patience=self.patience) as client:
                manifest, _ = client.manifest(dataset, version)
                root = f"/v1/datasets/{dataset}/versions/{version}/files/"
                kept = {file.path: client.request("GET", root + file.path).content for file in manifest.sections}
            return Contents(manifest, lambda file: kept[file.path])

        return await asyncio.to_thread(read)

    async def pull(self, dataset: str, version: int, target: Path) -> Pulled:
        """Download a version, in a thread of its own; see `stickslip_services.client.pulling`."""

        def download() -> Pulled:
            with Client(self.url, key=self._key, patience=self.patience) as client:
                return pull(client, dataset, version, target)

        return await asyncio.to_thread(download)

    async def workers(self) -> list[WorkerEntry]:
        """Return the workers."""
        return await self._ask(calls.workers())

    # --- certificates ---------------------------------------------------------------------------------------------

    def certificates(self) -> AsyncIterator[CertificateEntry]:
        """Yield all certificates, newest first."""
        return self._items(calls.certificates())

    async def certificate(self, digest: str) -> Certificate:
        """Return a certificate."""
        return await self._ask(calls.certificate(digest))

    async def register(self, upload: CertificateUpload) -> CertificateEntry:
        """Register a certificate; sent twice it is there once."""
        return await self._ask(calls.register(upload))

    # --- HTTP -----------------------------------------------------------------------------------------------------

    async def _ask(self, call: Call[T]) -> T:
        """Send a request, again where it did not come through; raise ClientError."""
        attempts = AsyncRetrying(**calls.retry_options(self.patience, lambda: self._was_answered))
        try:
            response: httpx.Response = await attempts(self._send, call)
        except httpx.TransportError as error:
            raise UnreachableError(f"{self.url} does not answer: {error or type(error).__name__}") from error
        except httpx.HTTPStatusError as error:
            raise_for_problem(error.response)
            raise UnexpectedError(f"{self.url} answered with status {error.response.status_code}") from error
        return call.read(response)

    async def _send(self, call: Call[T]) -> httpx.Response:
        response = await self._http.request(call.method, call.path, **call.options)
        self._was_answered = True
        if response.status_code == 503:
            response.raise_for_status()
        raise_for_problem(response)
        return response

    async def _items(self, call: Call[Page[T]]) -> AsyncIterator[T]:
        answer: Page[T] | None = None
        while (following := calls.next_page(call, answer)) is not None:
            answer = await self._ask(following)
            for item in answer.items:
                yield item
