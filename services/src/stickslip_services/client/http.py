"""The client of a coordinator: typed answers, problems as exceptions, retries during restarts."""

import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Self, TypeVar, Unpack
from urllib.parse import quote

import httpx
from stickslip_schemas.base import JobState, TaskState
from stickslip_schemas.documents import responses
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.format.manifest import Contents, FileEntry, Manifest
from stickslip_schemas.transport.addresses import (
    InvalidKeyError,
    api_key_of_environment,
    authorization,
    check_url,
    coordinator_url,
    without_password,
)
from stickslip_schemas.transport.http import (
    BUSY_STATUS,
    RETRY_SECONDS,
    AnswerError,
    HttpClient,
    RequestOptions,
    TransportError,
    read_bounded,
)
from stickslip_schemas.transport.limits import DOCUMENT_BYTES, check_values
from stickslip_schemas.transport.proxies import object_store_options

from stickslip_services.client.answers import parse, raise_for_problem
from stickslip_services.client.errors import (
    ClientError,
    DamagedError,
    MissingExtraError,
    UnexpectedError,
    UnreachableError,
)
from stickslip_services.client.events import Event, Message, read_event, read_messages

if TYPE_CHECKING:
    import zarr

T = TypeVar("T")

PAGE_SIZE = "200"
"""Items of a page: the most that the coordinator sends."""
MOST_PAGES = 10_000
"""Most pages of a list. A job has at most 1,000,000 samples, which are 5,000 pages."""
SILENCE_SECONDS = 60.0
"""How long an event stream may be silent [s]; the coordinator sends a keep-alive every 15 s."""
EVENT_PAUSE_SECONDS = 1.0
"""Pause before a lost event stream is opened again [s]."""


def _segment(text: str) -> str:
    """Return an id as a part of a path; `../x` must not lead to another resource."""
    return quote(text, safe="")


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
        retry_timeout: float = RETRY_SECONDS,
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Make a client of the coordinator at `url` that authenticates with an API key.

        Args:
            url: Defaults to STICKSLIP_URL, then to this machine.
            key: Defaults to STICKSLIP_API_KEY. If both are empty, requests carry no key.
            retry_timeout: How long a failed request is repeated [s].
            transport: Transport of httpx, for tests.
            sleep: Waits between attempts, for tests.

        Raises:
            ClientError: The URL has no scheme, or the key cannot be sent.
        """
        self.url = (url or coordinator_url()).rstrip("/")
        try:
            check_url(self.url)
        except ValueError as error:
            address = self.url.rpartition("@")[2]
            raise ClientError(f"the URL of the coordinator {error}: it is {address!r}") from error
        # A client is made for one coordinator, so the key of the environment is for it.
        self._sleep = sleep
        self._api_key = key or api_key_of_environment()
        try:
            self._http = HttpClient(
                self.url,
                api_key=self._api_key,
                retry_timeout=retry_timeout,
                transport=transport,
                sleep=sleep,
            )
        except InvalidKeyError as error:
            raise ClientError(str(error)) from error

    @property
    def retry_timeout(self) -> float:
        """How long a failed request is repeated [s]."""
        return self._http.retry_timeout

    @retry_timeout.setter
    def retry_timeout(self, seconds: float) -> None:
        self._http.retry_timeout = seconds

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
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
        # A request whose answer was lost is sent again, and must not make a second job.
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
        """Return a job."""
        return self._call(responses.JobDetail, "GET", f"/v1/jobs/{_segment(job_id)}")

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
        """Yield the samples of a job by slot, or only the samples in one state."""
        query = {} if state is None else {"state": str(state)}
        return self._items(
            responses.Page[responses.SampleState], f"/v1/jobs/{_segment(job_id)}/samples", query
        )

    def prioritise(self, job_id: str, priority: int) -> responses.JobDetail:
        """Set the priority of a job: tasks of the job with the highest number run first."""
        return self._call(
            responses.JobDetail,
            "PATCH",
            f"/v1/jobs/{_segment(job_id)}",
            json={"priority": priority},
        )

    def cancel(self, job_id: str) -> responses.JobDetail:
        """Cancel a job: running tasks are stopped, and results stay cached."""
        return self._call(responses.JobDetail, "POST", f"/v1/jobs/{_segment(job_id)}:cancel")

    def pause(self, job_id: str) -> responses.JobDetail:
        """Pause a job: running tasks finish, and no further task starts."""
        return self._call(responses.JobDetail, "POST", f"/v1/jobs/{_segment(job_id)}:pause")

    def resume(self, job_id: str) -> responses.JobDetail:
        """Resume a paused job."""
        return self._call(responses.JobDetail, "POST", f"/v1/jobs/{_segment(job_id)}:resume")

    def events(self, job_id: str) -> Iterator[Event]:
        """Yield the events of a job from its first one until it ends.

        A lost connection or a restart of the coordinator loses no event.
        """
        last_id = ""
        waited = 0.0
        while True:
            reason = "the event stream ended before the job"
            try:
                for message in self._messages(job_id, last_id):
                    waited = 0.0
                    last_id = message.id or last_id
                    event = read_event(message, self.url)
                    if event is not None:
                        yield event
                    if isinstance(event, responses.JobStateEvent) and not event.state.is_open:
                        return
            except TransportError as error:
                reason = str(error)
            # Keep-alives and events reset the clock: only silence counts.
            if waited >= self.retry_timeout:
                raise UnreachableError(f"{without_password(self.url)}: {reason}")
            self._sleep(EVENT_PAUSE_SECONDS)
            waited += EVENT_PAUSE_SECONDS

    def wait(self, job_id: str) -> responses.JobDetail:
        """Wait until a job has ended, as `events` does, and return it.

        Its `state` says how it ended.
        """
        for _ in self.events(job_id):
            pass
        return self.job(job_id)

    def _messages(self, job_id: str, last_id: str) -> Iterator[Message]:
        """Yield the messages of a job's stream after the message `last_id`."""
        # With the id of the last event, the coordinator continues after it.
        headers = {"Accept": "text/event-stream"}
        if last_id:
            headers["Last-Event-ID"] = last_id
        path = f"/v1/jobs/{_segment(job_id)}/events"
        stream = self._http.stream("GET", path, silence=SILENCE_SECONDS, headers=headers)
        try:
            with stream as response:
                self.check_status(response)
                yield from read_messages(response.iter_raw())
        except AnswerError as error:
            raise UnexpectedError(str(error)) from error

    def datasets(self) -> Iterator[responses.Dataset]:
        """Yield all datasets, newest first."""
        return self._items(responses.Page[responses.Dataset], "/v1/datasets")

    def dataset(self, dataset: str) -> responses.Dataset:
        return self._call(responses.Dataset, "GET", f"/v1/datasets/{_segment(dataset)}")

    def version(self, dataset: str, version: int) -> responses.DatasetVersion:
        return self._call(
            responses.DatasetVersion,
            "GET",
            f"/v1/datasets/{_segment(dataset)}/versions/{version}",
        )

    def find_dataset(self, name: str) -> responses.Dataset:
        """Return the dataset of a name.

        Raises:
            ClientError: No dataset has this name, or several have.
        """
        # Names are not unique, because two specs may have the same one.
        matches = [dataset for dataset in self.datasets() if dataset.name == name]
        if not matches:
            raise ClientError(
                f"there is no dataset {name!r}, by name or id: `stickslip datasets` lists them"
            )
        if len(matches) > 1:
            ids = ", ".join(dataset.id for dataset in matches)
            raise ClientError(f"{len(matches)} datasets have the name {name!r}: name one of {ids}")
        return matches[0]

    def contents(self, dataset: str, version: int) -> Contents:
        """Return the contents that the manifest of a version lists.

        Sections of a large one are fetched on demand.
        """
        root = f"/v1/datasets/{dataset}/versions/{version}"
        manifest = self._call(Manifest, "GET", f"{root}/manifest")
        return Contents(manifest, self.section_reader(f"{root}/files/"))

    def section_reader(self, root: str) -> Callable[[FileEntry], bytes]:
        """Return a function that fetches a section of the manifest of the files below `root`.

        It raises DamagedError for a section that is larger than any section can be.
        """

        def read(file: FileEntry) -> bytes:
            if file.size > DOCUMENT_BYTES:
                raise DamagedError(
                    f"{file.path} must have at most {DOCUMENT_BYTES} bytes, and the manifest says "
                    f"{file.size}"
                )
            content = self.request("GET", root + file.path, limit=file.size).content
            try:
                check_values(content)
            except ValueError as error:
                raise DamagedError(f"{file.path} {error}") from error
            return content

        return read

    def newest(self, dataset: str) -> int:
        """Return the number of the newest version of a dataset.

        Raise ClientError if it has none yet.
        """
        versions = self.dataset(dataset).versions
        if not versions:
            raise ClientError(f"dataset {dataset} has no version yet")
        return versions[-1].version

    def open(self, dataset: str, version: int | None = None) -> "zarr.Group":
        """Open a version of a dataset, the newest by default, as a Zarr group.

        Its chunks are downloaded when they are read. A missing chunk reads as the fill value: pull
        the dataset, or read it with stickslip-training, to get an error.

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
        # A version that does not exist is a problem of the coordinator, and not an empty group.
        self.version(dataset, number)
        url = f"{self.url}/v1/datasets/{dataset}/versions/{number}/files"
        # The crate has a client of its own, which gets the same key and the same proxy.
        options: Any = {
            "allow_http": True,
            "default_headers": authorization(self._api_key),
            **object_store_options(url),
        }
        store = HTTPStore(url, client_options=options)
        return zarr.open_group(ObjectStore(store, read_only=True), mode="r")

    def workers(self) -> list[responses.WorkerEntry]:
        return self._call(list[responses.WorkerEntry], "GET", "/v1/workers")

    def certificates(self) -> Iterator[responses.CertificateEntry]:
        """Yield all certificates, newest first."""
        return self._items(responses.Page[responses.CertificateEntry], "/v1/certificates")

    def register(self, certificate: Certificate) -> responses.CertificateEntry:
        """Register a certificate. Registering it again changes nothing."""
        headers = {"Content-Type": "application/json"}
        content = certificate.model_dump_json().encode()
        return self._call(
            responses.CertificateEntry, "POST", "/v1/certificates", content=content, headers=headers
        )

    def request(
        self,
        method: str,
        path: str,
        *,
        limit: int = DOCUMENT_BYTES,
        **options: Unpack[RequestOptions],
    ) -> httpx.Response:
        """Send a request, and repeat it while the connection fails or the coordinator is busy.

        Repeating is safe: requests that change something are idempotent or carry an idempotency
        key.

        Args:
            method: `GET` for example.
            path: Path below the URL of the coordinator.
            limit: Largest body that is accepted [bytes].
            options: Query, headers and body.

        Raises:
            ProblemError: The coordinator refused the request.
            UnreachableError: It does not answer.
            UnexpectedError: The answer is not one of a coordinator.
        """
        try:
            response = self._http.request(method, path, limit=limit, **options)
        except TransportError as error:
            raise UnreachableError(f"{without_password(self.url)} {error}") from error
        except AnswerError as error:
            raise UnexpectedError(str(error)) from error
        raise_for_problem(response)
        return response

    def stream(
        self, path: str, headers: Mapping[str, str]
    ) -> AbstractContextManager[httpx.Response]:
        """Open a download, whose body the caller reads with `iter_raw`.

        The caller handles TransportError and AnswerError.
        """
        return self._http.stream("GET", path, headers=headers)

    def check_status(self, response: httpx.Response) -> None:
        """Raise an error unless a response that is open reports success.

        Raises:
            TransportError: The coordinator is busy: the caller may try again.
            ProblemError: The coordinator refused the request.
            UnexpectedError: The answer is not one of a coordinator.
        """
        if response.is_success:
            return
        # The coordinator restarts or sheds load, and the request can be repeated.
        if response.status_code == BUSY_STATUS:
            raise TransportError("is busy")
        try:
            body = read_bounded(response, DOCUMENT_BYTES)
        except AnswerError as error:
            raise UnexpectedError(str(error)) from error
        raise_for_problem(
            httpx.Response(
                response.status_code,
                headers=response.headers,
                content=body,
                request=response.request,
            )
        )

    def _call(
        self, answer: type[T], method: str, path: str, **options: Unpack[RequestOptions]
    ) -> T:
        response = self.request(method, path, **options)
        return parse(answer, response.content, str(response.url))

    def _items(
        self, answer: type[responses.Page[T]], path: str, query: Mapping[str, str] | None = None
    ) -> Iterator[T]:
        """Yield the items of all pages of a list."""
        # A page names the next one, so jobs that are added meanwhile shift nothing.
        params = {"page_size": PAGE_SIZE, **(query or {})}
        for _ in range(MOST_PAGES):
            page = self._call(answer, "GET", path, params=params)
            yield from page.items
            if page.next_page_token is None:
                return
            params["page_token"] = page.next_page_token
        raise UnexpectedError(f"{without_password(self.url)}{path} has over {MOST_PAGES} pages")
