"""The HTTP client of a coordinator: typed answers, problems as exceptions, retries while the
coordinator restarts.

Each case that callers tell apart has a `ClientError` of a class of its own.
"""

import os
import random
import secrets
import ssl
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from itertools import chain, repeat
from typing import TYPE_CHECKING, Any, Self, TypeVar

import httpx
from pydantic import TypeAdapter, ValidationError
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents import responses
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.problems import MEDIA_TYPE, Problem
from stickslip_schemas.format.manifest import Contents, Manifest
from stickslip_schemas.installation import install_hint

from stickslip_services.addresses import DEFAULT_URL

if TYPE_CHECKING:
    import zarr


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
        super().__init__(f"{what} is not installed: {install_hint('stickslip', extra)}")


def raise_for_problem(response: httpx.Response) -> None:
    """Raise ProblemError or UnexpectedError unless a response, whose body has been read, reports
    success.
    """
    if response.is_success:
        return
    if response.headers.get("content-type", "").startswith(MEDIA_TYPE):
        try:
            problem = Problem.model_validate_json(response.content)
        except ValidationError as error:
            raise UnexpectedError(
                f"{response.url} answered with an invalid problem document"
            ) from error
        raise ProblemError(problem)
    raise UnexpectedError(
        f"{response.url} answered with status {response.status_code}; is it a coordinator?"
    )


T = TypeVar("T")

Event = (
    responses.JobStateEvent
    | responses.JobProgressEvent
    | responses.TaskStateEvent
    | responses.DatasetPublishedEvent
)

_EVENTS: Mapping[str, type[Event]] = {
    responses.EventName.job_state: responses.JobStateEvent,
    responses.EventName.job_progress: responses.JobProgressEvent,
    responses.EventName.task_state: responses.TaskStateEvent,
    responses.EventName.dataset_published: responses.DatasetPublishedEvent,
}

PAGE_SIZE = "200"

PATIENCE_SECONDS = 60.0
"""How long a failed request is repeated [s]."""
PAUSES_SECONDS = (0.25, 0.5, 1.0, 2.0, 3.0)
"""Longest pauses between tries [s], the last one again and again; a drawn share of them is waited.
"""
SILENCE_SECONDS = 60.0
"""Read timeout of an event stream [s]; the coordinator sends a keep-alive every 15 s."""


class Client:
    """A client of one coordinator, and a context manager that closes its connections.

    Its methods block. Asynchronous programs call them in a thread: `await
    asyncio.to_thread(client.submit, spec)`.
    """

    def __init__(
        self,
        url: str | None = None,
        *,
        key: str | None = None,
        patience: float = PATIENCE_SECONDS,
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Make a client of the coordinator at `url` that authenticates with an API key.

        Args:
            url: Defaults to STICKSLIP_URL, then to this machine.
            key: Defaults to STICKSLIP_KEY; without either, requests carry no key.
            patience: How long a failed request is repeated [s].
            transport: Transport of httpx, for tests.
            sleep: Waits between attempts, for tests.

        Raises:
            ClientError: The URL has no scheme.
        """
        self.url = (url or os.environ.get("STICKSLIP_URL") or DEFAULT_URL).rstrip("/")
        if not self.url.startswith(("http://", "https://")):
            raise ClientError(
                f"the URL of the coordinator must begin with http:// or https://: it is {self.url!r}"
            )
        self.patience = patience
        self._sleep = sleep
        self._was_answered = False
        key = key or os.environ.get("STICKSLIP_KEY")
        # trust_env is off because a proxy of the environment is for the internet. SSL_CERT_FILE
        # still applies: only this machine may trust the authority of the coordinator's certificate.
        authorities = os.environ.get("SSL_CERT_FILE") if self.url.startswith("https") else None
        self._http = httpx.Client(
            base_url=self.url,
            timeout=httpx.Timeout(60.0, connect=5.0),
            headers={} if key is None else {"Authorization": f"Bearer {key}"},
            verify=ssl.create_default_context(cafile=authorities) if authorities else True,
            trust_env=False,
            transport=transport,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def validate(self, spec: Mapping[str, Any]) -> responses.Validation:
        """Validate a spec and count its samples and tasks, without submitting it."""
        return self._call(responses.Validation, "POST", "/v1/jobs:validate", json=spec)

    def submit(
        self, spec: Mapping[str, Any], *, idempotency_key: str | None = None, priority: int = 0
    ) -> responses.JobDetail:
        """Submit a job.

        Requests with the same idempotency key make one job; by default each call has a new key.
        """
        headers = {"Idempotency-Key": idempotency_key or secrets.token_hex(16)}
        query = {"priority": str(priority)} if priority else {}
        return self._call(
            responses.JobDetail, "POST", "/v1/jobs", json=spec, headers=headers, params=query
        )

    def upload_texture(self, picture: bytes) -> responses.TextureEntry:
        """Upload a PNG or JPEG file as a texture, which specs name under `textures`."""
        media_type = "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"
        return self._call(
            responses.TextureEntry,
            "POST",
            "/v1/textures",
            content=picture,
            headers={"Content-Type": media_type},
        )

    def upload_file(self, data: bytes) -> responses.FileUpload:
        """Upload a file that the document of a scene names."""
        octets = {"Content-Type": "application/octet-stream"}
        return self._call(responses.FileUpload, "POST", "/v1/files", content=data, headers=octets)

    def job(self, job_id: str) -> responses.JobDetail:
        return self._call(responses.JobDetail, "GET", f"/v1/jobs/{job_id}")

    def jobs(
        self, *, search: str = "", state: JobState | None = None, project: str = ""
    ) -> Iterator[responses.Job]:
        """Yield jobs, newest first; `search` is a part of the name, kind, id or dataset."""
        query = {"search": search, "state": str(state or ""), "project": project}
        return self._items(
            responses.Page[responses.Job],
            "/v1/jobs",
            {name: value for name, value in query.items() if value},
        )

    def samples(
        self, job_id: str, *, state: TaskState | None = None
    ) -> Iterator[responses.SampleState]:
        query = {} if state is None else {"state": str(state)}
        return self._items(
            responses.Page[responses.SampleState], f"/v1/jobs/{job_id}/samples", query
        )

    def prioritise(self, job_id: str, priority: int) -> responses.JobDetail:
        """Set the priority of a job: tasks of the job with the highest number run first."""
        return self._call(
            responses.JobDetail, "PATCH", f"/v1/jobs/{job_id}", json={"priority": priority}
        )

    def cancel(self, job_id: str) -> responses.JobDetail:
        return self._call(responses.JobDetail, "POST", f"/v1/jobs/{job_id}:cancel")

    def pause(self, job_id: str) -> responses.JobDetail:
        """Pause a job: running tasks finish, and no further task starts."""
        return self._call(responses.JobDetail, "POST", f"/v1/jobs/{job_id}:pause")

    def resume(self, job_id: str) -> responses.JobDetail:
        return self._call(responses.JobDetail, "POST", f"/v1/jobs/{job_id}:resume")

    def events(self, job_id: str) -> Iterator[Event]:
        """Yield the events of a job until it ends, across lost connections and restarts of the
        coordinator.
        """
        last_id = ""
        waited = 0.0
        while True:
            try:
                for message in self._stream(job_id, last_id):
                    waited = 0.0
                    last_id = message.get("id", last_id)
                    event = _read_event(message)
                    if event is not None:
                        yield event
                    if isinstance(event, responses.JobStateEvent) and not event.state.is_open:
                        return
                reason = "the event stream ended before the job"
            except httpx.TransportError as error:
                reason = str(error) or type(error).__name__
            if waited >= self.patience:
                raise UnreachableError(f"{self.url} does not answer: {reason}")
            self._sleep(1.0)
            waited += 1.0

    def wait(self, job_id: str) -> responses.JobDetail:
        """Wait until a job has ended, as `events` does, and return it: its `state` says how it
        ended.
        """
        for _ in self.events(job_id):
            pass
        return self.job(job_id)

    def _stream(self, job_id: str, last_id: str) -> Iterator[dict[str, str]]:
        headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": last_id} if last_id else {})
        timeout = httpx.Timeout(SILENCE_SECONDS, connect=5.0)
        with self._http.stream(
            "GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout
        ) as response:
            if response.status_code == 503:
                raise httpx.ReadError("the coordinator is busy")
            if not response.is_success:
                response.read()
            raise_for_problem(response)
            received = ""
            for text in response.iter_text():
                *messages, received = (received + text).split("\n\n")
                for message in messages:
                    lines = (line.partition(": ") for line in message.split("\n"))
                    yield {name: value for name, _, value in lines}

    def datasets(self) -> Iterator[responses.Dataset]:
        """Yield all datasets, newest first."""
        return self._items(responses.Page[responses.Dataset], "/v1/datasets")

    def dataset(self, dataset: str) -> responses.Dataset:
        return self._call(responses.Dataset, "GET", f"/v1/datasets/{dataset}")

    def version(self, dataset: str, version: int) -> responses.DatasetVersion:
        return self._call(
            responses.DatasetVersion, "GET", f"/v1/datasets/{dataset}/versions/{version}"
        )

    def contents(self, dataset: str, version: int) -> Contents:
        """Return what the manifest of a version lists.

        Sections of a large one are fetched on demand.
        """
        root = f"/v1/datasets/{dataset}/versions/{version}"
        manifest = self._call(Manifest, "GET", f"{root}/manifest")
        return Contents(
            manifest, lambda file: self.request("GET", f"{root}/files/{file.path}").content
        )

    def newest(self, dataset: str) -> int:
        """Return the number of the newest version of a dataset.

        Raise ClientError if it has none yet.
        """
        versions = self.dataset(dataset).versions
        if not versions:
            raise ClientError(f"dataset {dataset} has no version yet")
        return versions[-1].version

    def open(self, dataset: str, version: int | None = None) -> "zarr.Group":
        """Open a version of a dataset, the newest by default, as a Zarr group, whose chunks are
        downloaded when read.

        A missing chunk reads as the fill value: pull the dataset, or read it with
        stickslip-training, to get an error.

        Raises:
            MissingExtraError: The extra `arrays` is not installed.
            ClientError: The coordinator refused, or does not answer.
        """
        try:
            import zarr
            from obstore.store import HTTPStore
            from zarr.storage import ObjectStore
        except ImportError as error:
            raise MissingExtraError(
                "arrays", f"to open a dataset needs zarr and obstore, and {error.name}"
            ) from error
        number = self.newest(dataset) if version is None else version
        self.version(dataset, number)
        files = f"{self.url}/v1/datasets/{dataset}/versions/{number}/files"
        key = {name: value for name, value in self._http.headers.items() if name == "authorization"}
        store = HTTPStore(files, client_options={"allow_http": True, "default_headers": key})
        return zarr.open_group(ObjectStore(store, read_only=True), mode="r")

    def workers(self) -> list[responses.WorkerEntry]:
        return self._call(list[responses.WorkerEntry], "GET", "/v1/workers")

    def certificates(self) -> Iterator[responses.CertificateEntry]:
        """Yield all certificates, newest first."""
        return self._items(responses.Page[responses.CertificateEntry], "/v1/certificates")

    def register(self, certificate: Certificate) -> responses.CertificateEntry:
        """Register a certificate. Registering it again changes nothing."""
        headers = {"Content-Type": "application/json"}
        content = certificate.model_dump_json()
        return self._call(
            responses.CertificateEntry, "POST", "/v1/certificates", content=content, headers=headers
        )

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request, and repeat it while the connection fails or the coordinator is busy.

        Repeating is safe: requests that change something are idempotent or carry an idempotency
        key. Raises ClientError.
        """
        until = time.monotonic() + self.patience
        for pause in chain(PAUSES_SECONDS, repeat(PAUSES_SECONDS[-1])):
            last = time.monotonic() >= until
            try:
                response = self._http.request(method, path, **options)
            except httpx.TransportError as error:
                # A coordinator that has answered before may be restarting.
                if last or (isinstance(error, httpx.ConnectError) and not self._was_answered):
                    raise UnreachableError(
                        f"{self.url} does not answer: {error or type(error).__name__}"
                    ) from error
            else:
                self._was_answered = True
                if last or response.status_code != 503:
                    raise_for_problem(response)
                    return response
            self._sleep(pause * random.random())
        raise AssertionError

    def stream(
        self, path: str, headers: Mapping[str, str]
    ) -> AbstractContextManager[httpx.Response]:
        """Open a download; the caller handles connection errors."""
        return self._http.stream("GET", path, headers=headers)

    def _call(self, answer: type[T], method: str, path: str, **options: Any) -> T:
        return parsed(answer, self.request(method, path, **options))

    def _items(
        self, answer: type[responses.Page[T]], path: str, query: Mapping[str, str] | None = None
    ) -> Iterator[T]:
        token: str | None = ""
        while token is not None:
            params = {"page_size": PAGE_SIZE, **(query or {})} | (
                {"page_token": token} if token else {}
            )
            page = self._call(answer, "GET", path, params=params)
            yield from page.items
            token = page.next_page_token


def parsed(answer: type[T], response: httpx.Response) -> T:
    """Return the document of a response; raise UnexpectedError."""
    try:
        return TypeAdapter(answer).validate_json(response.content)
    except ValidationError as error:
        raise UnexpectedError(f"{response.url} sent an unexpected answer: {error}") from error


def _read_event(message: Mapping[str, str]) -> Event | None:
    """Return an event, None for one that only newer versions know; raise UnexpectedError."""
    name = message.get("event", "")
    model = _EVENTS.get(name)
    if model is None:
        return None
    try:
        return model.model_validate_json(message.get("data", ""))
    except ValueError as error:
        raise UnexpectedError(f"the event {name} has unexpected data: {error}") from error
