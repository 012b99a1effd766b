"""What a client may ask a coordinator for: each call as data, the same for both clients."""

import json
import os
import secrets
import ssl
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import httpx
from pydantic import TypeAdapter, ValidationError
from stickslip_schemas.base.states import TaskState
from stickslip_schemas.documents.certificate import Certificate, CertificateUpload
from stickslip_schemas.documents.problems import MEDIA_TYPE, Problem
from stickslip_schemas.documents.responses import (
    CertificateEntry,
    Dataset,
    DatasetPublishedEvent,
    DatasetVersion,
    EventName,
    Job,
    JobDetail,
    JobProgressEvent,
    JobStateEvent,
    Page,
    Preview,
    SampleState,
    TaskStateEvent,
    TextureEntry,
    Validation,
    WorkerEntry,
)
from stickslip_schemas.format.manifest import Manifest
from tenacity import retry_if_exception, stop_after_delay, wait_random_exponential

T = TypeVar("T")

Event = JobStateEvent | JobProgressEvent | TaskStateEvent | DatasetPublishedEvent

_EVENTS: Mapping[str, type[Event]] = {
    EventName.job_state: JobStateEvent,
    EventName.job_progress: JobProgressEvent,
    EventName.task_state: TaskStateEvent,
    EventName.dataset_published: DatasetPublishedEvent,
}

PAGE_SIZE = "200"

PATIENCE_SECONDS = 60.0
"""How long a request that did not come through is sent again [s]."""
SILENCE_SECONDS = 60.0
"""How long an event stream may be silent, whose keep-alives come every 15 s, before it is taken for dead [s]."""
STREAM_TIMEOUT = httpx.Timeout(SILENCE_SECONDS, connect=5.0)


def connection_options(url: str, key: str | None) -> dict[str, Any]:
    """Return the options of an httpx client for the coordinator at `url`, with an API key if there is one."""
    key = key or os.environ.get("STICKSLIP_KEY")
    # A proxy of the environment is for the world outside. SSL_CERT_FILE counts: a coordinator's certificate may be of
    # an authority that only this machine trusts.
    authorities = os.environ.get("SSL_CERT_FILE")
    return {
        "base_url": url,
        "timeout": httpx.Timeout(60.0, connect=5.0),
        "headers": {} if key is None else {"Authorization": f"Bearer {key}"},
        "verify": ssl.create_default_context(cafile=authorities) if authorities and url.startswith("https") else True,
        "trust_env": False,
    }


def retry_options(patience: float, was_answered: Callable[[], bool]) -> dict[str, Any]:
    """Return tenacity's options for a request: it is sent again for `patience` [s] while the error may be gone soon.

    A coordinator that has answered once may be restarting; one that never has is not there.
    """

    def may_pass(error: BaseException) -> bool:
        if isinstance(error, httpx.ConnectError) and not was_answered():
            return False
        return isinstance(error, httpx.TransportError | httpx.HTTPStatusError)

    return {
        "retry": retry_if_exception(may_pass),
        "wait": wait_random_exponential(multiplier=0.25, max=3),
        "stop": stop_after_delay(patience),
        "reraise": True,
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


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """A request, and what its answer is read as."""

    method: str
    path: str
    answer: TypeAdapter[T]
    options: dict[str, Any] = field(default_factory=dict)

    def read(self, response: httpx.Response) -> T:
        """Return the answer; raise UnexpectedError."""
        try:
            return self.answer.validate_json(response.content)
        except ValidationError as error:
            raise UnexpectedError(f"{response.url} answered with something else than expected: {error}") from error


_JOB: TypeAdapter[JobDetail] = TypeAdapter(JobDetail)


def validate(spec: Mapping[str, Any]) -> Call[Validation]:
    """Ask what a job would be."""
    return Call("POST", "/v1/jobs:validate", TypeAdapter(Validation), {"json": spec})


def submit(spec: Mapping[str, Any], idempotency_key: str | None, priority: int) -> Call[JobDetail]:
    """Submit a job; without a key, one is made."""
    headers = {"Idempotency-Key": idempotency_key or secrets.token_hex(16)}
    query = {"priority": str(priority)} if priority else {}
    return Call("POST", "/v1/jobs", _JOB, {"json": spec, "headers": headers, "params": query})


def prioritise(job_id: str, priority: int) -> Call[JobDetail]:
    """Give a job another priority."""
    return Call("PATCH", f"/v1/jobs/{job_id}", _JOB, {"json": {"priority": priority}})


def job(job_id: str) -> Call[JobDetail]:
    """Ask for a job."""
    return Call("GET", f"/v1/jobs/{job_id}", _JOB)


def change(job_id: str, verb: str) -> Call[JobDetail]:
    """Cancel, pause or resume a job."""
    return Call("POST", f"/v1/jobs/{job_id}:{verb}", _JOB)


def jobs() -> Call[Page[Job]]:
    """Ask for a page of jobs."""
    return Call("GET", "/v1/jobs", TypeAdapter(Page[Job]))


def samples(job_id: str, state: TaskState | None) -> Call[Page[SampleState]]:
    """Ask for a page of the samples of a job."""
    query = {} if state is None else {"state": str(state)}
    return Call("GET", f"/v1/jobs/{job_id}/samples", TypeAdapter(Page[SampleState]), {"params": query})


def previews(job_id: str) -> Call[list[Preview]]:
    """Ask for the previews of a job."""
    return Call("GET", f"/v1/jobs/{job_id}/previews", TypeAdapter(list[Preview]))


def datasets() -> Call[Page[Dataset]]:
    """Ask for a page of datasets."""
    return Call("GET", "/v1/datasets", TypeAdapter(Page[Dataset]))


def dataset(dataset: str) -> Call[Dataset]:
    """Ask for a dataset."""
    return Call("GET", f"/v1/datasets/{dataset}", TypeAdapter(Dataset))


def version(dataset: str, version: int) -> Call[DatasetVersion]:
    """Ask for a version of a dataset."""
    return Call("GET", f"/v1/datasets/{dataset}/versions/{version}", TypeAdapter(DatasetVersion))


def manifest(dataset: str, version: int) -> Call[Manifest]:
    """Ask for the manifest of a version."""
    return Call("GET", f"/v1/datasets/{dataset}/versions/{version}/manifest", TypeAdapter(Manifest))


def workers() -> Call[list[WorkerEntry]]:
    """Ask for the workers."""
    return Call("GET", "/v1/workers", TypeAdapter(list[WorkerEntry]))


def certificates() -> Call[Page[CertificateEntry]]:
    """Ask for a page of certificates."""
    return Call("GET", "/v1/certificates", TypeAdapter(Page[CertificateEntry]))


def certificate(digest: str) -> Call[Certificate]:
    """Ask for a certificate."""
    return Call("GET", f"/v1/certificates/{digest}", TypeAdapter(Certificate))


def register(upload: CertificateUpload) -> Call[CertificateEntry]:
    """Register a certificate."""
    options = {"content": upload.model_dump_json(), "headers": {"Content-Type": "application/json"}}
    return Call("POST", "/v1/certificates", TypeAdapter(CertificateEntry), options)


def upload_texture(picture: bytes) -> Call[TextureEntry]:
    """Upload a texture."""
    media_type = "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"
    options = {"content": picture, "headers": {"Content-Type": media_type}}
    return Call("POST", "/v1/textures", TypeAdapter(TextureEntry), options)


def next_page(call: Call[Page[T]], answer: Page[T] | None) -> Call[Page[T]] | None:
    """Return the call for the page after `answer`, for the first one if it is None; None after the last."""
    if answer is not None and answer.next_page_token is None:
        return None
    query = {"page_size": PAGE_SIZE, **call.options.get("params", {})}
    if answer is not None:
        query["page_token"] = answer.next_page_token
    return Call(call.method, call.path, call.answer, call.options | {"params": query})


def event_headers(last_id: str) -> dict[str, str]:
    """Return the headers of a request for the events after `last_id`, which may be empty."""
    return {"Accept": "text/event-stream"} | ({"Last-Event-ID": last_id} if last_id else {})


def read_event(name: str, data: str) -> Event | None:
    """Return an event, or None where a newer coordinator tells something that this version does not know."""
    model = _EVENTS.get(name)
    if model is None:
        return None
    try:
        return model.model_validate(json.loads(data))
    except ValueError as error:
        raise UnexpectedError(f"the event {name} holds something else than expected: {error}") from error


def raise_for_problem(response: httpx.Response) -> None:
    """Raise ProblemError or UnexpectedError where the coordinator, whose answer has been read, did not do it."""
    if response.is_success:
        return
    if response.headers.get("content-type", "").startswith(MEDIA_TYPE):
        try:
            problem = Problem.model_validate_json(response.content)
        except ValidationError as error:
            raise UnexpectedError(f"{response.url} answered with a problem that is none") from error
        raise ProblemError(problem)
    raise UnexpectedError(f"{response.url} answered with status {response.status_code}; is it a coordinator?")
