"""The asynchronous client does what the other one does."""

import asyncio
import inspect
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from stickslip_schemas.documents.responses import DatasetPublishedEvent, JobStateEvent
from stickslip_services.client import AsyncClient, Client, ProblemError, UnreachableError, verify
from stickslip_services.coordinator import make_app
from stickslip_services.settings import Settings
from stickslip_services.testing import PretendWorker, rods, serving


@pytest.fixture
def app(settings: Settings) -> FastAPI:
    return make_app(settings)


def test_both_clients_have_the_same_verbs() -> None:
    def verbs(of: type) -> set[str]:
        return {name for name, _ in inspect.getmembers(of, inspect.isfunction) if not name.startswith("_")}

    only_here = {"pull"}  # the synchronous client is given to `pull`
    only_there = {"request", "stream", "certificate_page"}
    assert verbs(AsyncClient) - only_here == verbs(Client) - only_there


def test_a_job_from_its_spec_to_its_files(app: FastAPI, tmp_path: Path) -> None:
    async def use(url: str) -> None:
        coordinator = app.state.coordinator
        worker = PretendWorker(coordinator, coordinator.store).register()
        async with AsyncClient(url) as client:
            assert (await client.validate(rods())).sample_count == 4
            job = await client.submit(rods(), idempotency_key="mine")
            assert (await client.submit(rods(), idempotency_key="mine")).id == job.id
            other, another = await client.submit(rods(gamma=(5.0,))), await client.submit(rods(gamma=(5.0,)))
            assert other.id != another.id  # without a key, each has its own
            await client.cancel(other.id)
            assert [shown.id async for shown in client.jobs()] == [another.id, other.id, job.id]
            await asyncio.to_thread(worker.work)
            events = [event async for event in client.events(job.id)]
            assert isinstance(events[-1], JobStateEvent)
            (made,) = [event for event in events if isinstance(event, DatasetPublishedEvent)]
            assert len([sample async for sample in client.samples(job.id)]) == 4
            assert len(await client.previews(job.id)) == 4
            pulled = await client.pull(made.dataset.dataset, 1, tmp_path / "dataset")
            assert pulled.downloaded_files == pulled.files
            with pytest.raises(ProblemError, match="there is no job"):
                await client.job("job-0")

    with serving(app) as url:
        asyncio.run(use(url))
    assert verify(tmp_path / "dataset") == []


def test_nobody_there_is_said_at_once_and_a_restart_is_waited_for() -> None:
    answers = iter([httpx.Response(200, json=[]), httpx.ConnectError("gone"), httpx.Response(200, json=[])])

    def handler(_: httpx.Request) -> httpx.Response:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, httpx.Response)
        return answer

    async def use() -> None:
        async with AsyncClient("http://127.0.0.1:9", patience=60) as client:
            with pytest.raises(UnreachableError):
                await asyncio.wait_for(client.workers(), 5)
        async with AsyncClient(transport=httpx.MockTransport(handler)) as client:
            assert await client.workers() == []
            assert await client.workers() == []

    asyncio.run(use())
