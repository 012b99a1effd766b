"""Coordinators that answer over HTTP, in a thread of the test process or in a separate process."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import httpx
import uvicorn
from fastapi import FastAPI
from pydantic import BaseModel
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
from stickslip_schemas.store import DirectoryStore
from stickslip_services.api.protocol import PatientProtocol
from stickslip_services.app import make_app
from stickslip_services.local.supervisor import listen
from stickslip_services.settings import Settings

from stickslip_testing.worker import PretendWorker

A = TypeVar("A", bound=BaseModel)


@dataclass
class RunningServer:
    """A coordinator that answers over HTTP."""

    url: str
    data: Path

    @property
    def store(self) -> DirectoryStore:
        """The store of the coordinator."""
        return DirectoryStore(self.data / "store")

    def worker(self, **options: Any) -> PretendWorker:
        """Return a registered worker that calls the server over HTTP."""
        key = (self.data / "worker-key").read_text().strip()
        return PretendWorker(HttpApi(self.url, key), self.store, **options).register()


@dataclass
class ServerProcess(RunningServer):
    """A coordinator in a separate process."""

    process: "subprocess.Popen[str]"

    def stop(self) -> None:
        """Stop the process."""
        self.process.terminate()
        self.process.wait(100)
        if self.process.stdout is not None:
            self.process.stdout.close()


class HttpApi:
    """The worker API over HTTP."""

    def __init__(
        self, url: str, key: str, post: Callable[..., httpx.Response] | None = None
    ) -> None:
        self._url = url
        self._key = key
        self._send = post or partial(httpx.post, trust_env=False)
        """Sends a request; by default over a new connection."""

    def register(self, document: WorkerRegistration) -> WorkerSession:
        """Register a worker."""
        return self._post("/v1/workers", document, WorkerSession)

    def lease(self, document: LeaseRequest) -> LeaseBatch:
        """Lease tasks."""
        return self._post("/v1/worker/lease", document, LeaseBatch)

    def heartbeat(self, document: Heartbeat) -> HeartbeatAnswer:
        """Renew leases."""
        return self._post("/v1/worker/heartbeat", document, HeartbeatAnswer)

    def report(self, document: ReportBatch) -> ReportAnswer:
        """Report results."""
        return self._post("/v1/worker/report", document, ReportAnswer)

    def _post(self, path: str, document: BaseModel, answer: type[A]) -> A:
        content, headers = document.model_dump_json(), {"Content-Type": "application/json"}
        headers["Authorization"] = f"Bearer {self._key}"
        response = self._send(self._url + path, content=content, headers=headers)
        response.raise_for_status()
        return answer.model_validate_json(response.content)


@contextmanager
def serving(app: FastAPI) -> Iterator[str]:
    """Serve an application from a thread of this process; yield its URL."""
    listener = listen("127.0.0.1", 0)
    config = uvicorn.Config(
        app, log_level="error", lifespan="on", timeout_graceful_shutdown=1, http=PatientProtocol
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        wait_until(lambda: server.started or not thread.is_alive())
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


@contextmanager
def served(data: Path) -> Iterator[RunningServer]:
    """Serve a coordinator with the data directory `data` from a thread of this process.

    It starts in 0.2 s.
    """
    with serving(make_app(Settings(data=data, durable=False))) as url:
        yield RunningServer(url, data)


def start_server(data: Path, port: int = 0, options: Sequence[str] = ()) -> ServerProcess:
    """Start a coordinator in a separate process, which takes 2 s, and wait until it answers."""
    command = [
        sys.executable,
        "-m",
        "stickslip_services.app",
        "--data",
        str(data),
        "--port",
        str(port),
    ]
    command += options
    log = (data.parent / f"{data.name}.log").open("ab")
    with log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
    assert process.stdout is not None
    words = process.stdout.readline().split()
    assert words, "the coordinator did not start"
    return ServerProcess(words[-1], data, process)


def wait_until(condition: Callable[[], bool], *, seconds: float = 100.0) -> None:
    """Return when `condition` holds; fail after `seconds`."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"the condition did not hold within {seconds:g} s"
        time.sleep(0.02)
