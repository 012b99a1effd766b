"""The client: a job from its spec to its files, also from asynchronous programs, and restarts of
the coordinator.
"""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from stickslip_schemas.base import JobState
from stickslip_schemas.documents.responses import DatasetPublishedEvent, JobStateEvent
from stickslip_services.app import make_app
from stickslip_services.client import (
    Client,
    ClientError,
    ProblemError,
    UnexpectedError,
    UnreachableError,
    pull,
    verify,
)
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker


@pytest.fixture
def app(settings: Settings) -> FastAPI:
    return make_app(settings)


def test_a_job_from_its_spec_to_its_files(app: FastAPI, tmp_path: Path) -> None:
    context = app.state.context
    with serving(app) as url, Client(url) as client:
        worker = PretendWorker(DirectApi(context), context.store).register()
        assert client.validate(rods()).sample_count == 4
        job = client.submit(rods(), idempotency_key="mine")
        assert client.submit(rods(), idempotency_key="mine").id == job.id
        other, another = client.submit(rods(gamma=(5.0,))), client.submit(rods(gamma=(5.0,)))
        assert other.id != another.id  # by default each call has a new key
        client.cancel(other.id)
        assert [listed.id for listed in client.jobs()] == [another.id, other.id, job.id]
        worker.work()
        ended = client.wait(job.id)
        assert ended.state == JobState.succeeded
        events = list(client.events(job.id))
        assert isinstance(events[-1], JobStateEvent)
        (published,) = [event for event in events if isinstance(event, DatasetPublishedEvent)]
        lines = [str(event) for event in events]
        assert lines[-1] == "succeeded"
        assert f"published {published.dataset.dataset}:v1" in lines
        assert all("\n" not in line and len(line) < 120 for line in lines)
        assert (
            len(list(client.samples(job.id)))
            == len(client.request("GET", f"/v1/jobs/{job.id}/previews").json())
            == 4
        )
        pulled = pull(client, published.dataset.dataset, 1, tmp_path / "dataset")
        assert pulled.downloaded_files == pulled.files
        with pytest.raises(ProblemError, match="there is no job"):
            client.job("job-0")
    assert verify(tmp_path / "dataset") == []


def test_asynchronous_programs_call_the_client_in_threads(app: FastAPI) -> None:
    async def use(url: str) -> None:
        with Client(url) as client:
            specs = [rods(gamma=(value,)) for value in (5.0, 6.0, 7.0)]
            submitted = await asyncio.gather(
                *(asyncio.to_thread(client.submit, spec) for spec in specs)
            )
            assert {job.id for job in submitted} == {
                job.id for job in await asyncio.to_thread(list, client.jobs())
            }

    with serving(app) as url:
        asyncio.run(use(url))


def test_a_url_without_a_scheme_is_refused() -> None:
    with pytest.raises(
        ClientError, match=r"must begin with http:// or https://: it is 'localhost:8765'"
    ):
        Client("localhost:8765")


def test_a_list_that_never_ends_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stickslip_services.client.http.MOST_PAGES", 3)
    page = {"items": [], "next_page_token": "more"}
    endless = httpx.MockTransport(lambda _: httpx.Response(200, json=page))
    with (
        Client(transport=endless) as client,
        pytest.raises(UnexpectedError, match="/v1/datasets has over 3 pages"),
    ):
        list(client.datasets())


def test_a_missing_coordinator_is_reported_at_once_and_a_restart_is_waited_for() -> None:
    answers: Iterator[httpx.Response | httpx.ConnectError] = iter(
        [httpx.Response(200, json=[]), httpx.ConnectError("gone"), httpx.Response(200, json=[])]
    )
    slept: list[float] = []

    def handler(_: httpx.Request) -> httpx.Response:
        answer = next(answers)
        if isinstance(answer, httpx.Response):
            return answer
        raise answer

    with (
        Client("http://127.0.0.1:9", retry_timeout=60, sleep=slept.append) as client,
        pytest.raises(UnreachableError),
    ):
        client.workers()
    assert slept == []
    with Client(transport=httpx.MockTransport(handler), sleep=slept.append) as client:
        assert client.workers() == []
        assert client.workers() == []
    assert len(slept) == 1
