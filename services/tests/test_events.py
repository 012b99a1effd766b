"""Event streams: complete, resumable, ending."""

import json
import threading
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from httpx_sse import ServerSentEvent, connect_sse
from stickslip_services.api import sse
from stickslip_services.app import make_app
from stickslip_services.queue.background import sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import show_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, rods
from stickslip_testing.servers import serving, wait_until
from stickslip_testing.worker import DirectApi, PretendWorker, failure

pytestmark = pytest.mark.databases


@pytest.fixture
def app(settings: Settings, clock: ManualClock) -> FastAPI:
    return make_app(settings, clock=clock)


@pytest.fixture
def client(app: FastAPI) -> Iterator[httpx.Client]:
    with serving(app) as url, httpx.Client(base_url=url, timeout=20) as client:
        yield client


@pytest.fixture
def worker(app: FastAPI, client: httpx.Client) -> PretendWorker:
    return PretendWorker(DirectApi(app.state.context), app.state.context.store).register()


def follow(client: httpx.Client, job: str, last_id: str | None = None) -> Iterator[ServerSentEvent]:
    headers = {} if last_id is None else {"Last-Event-ID": last_id}
    with connect_sse(client, "GET", f"/v1/jobs/{job}/events", headers=headers) as source:
        assert source.response.status_code == 200
        assert source.response.headers["content-type"].startswith("text/event-stream")
        yield from source.iter_sse()


def submit(client: httpx.Client, **spec: Any) -> str:
    response = client.post("/v1/jobs", json=rods(**spec))
    return str(response.json()["id"])


def words(events: list[ServerSentEvent]) -> list[str]:
    return [json.loads(event.data)["state"] for event in events if event.event == "job.state"]


def test_a_finished_job_is_told_from_the_beginning(
    client: httpx.Client, worker: PretendWorker
) -> None:
    job = submit(client)
    worker.work()
    events = list(follow(client, job))
    assert words(events) == ["queued", "running", "succeeded"]
    assert [event.event for event in events[-3:]] == [
        "dataset.published",
        "job.progress",
        "job.state",
    ]
    ids = [int(event.id) for event in events if event.event != "job.progress"]
    assert ids == sorted(set(ids))
    progress = json.loads(events[-2].data)["progress"]
    assert (progress["done"], progress["total"]) == (11, 11)


def test_a_stream_goes_on_after_the_last_event_that_was_seen(
    client: httpx.Client, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(client)
    worker.report((worker.lease(simulate=1)[0], failure()))
    clock.advance(5)
    worker.work()
    everything = [event for event in follow(client, job) if event.event != "job.progress"]
    for position, event in enumerate(everything):
        rest = [item for item in follow(client, job, event.id) if item.event != "job.progress"]
        assert [item.id for item in rest] == [item.id for item in everything[position + 1 :]]
    problem = client.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "x"})
    assert problem.status_code == 422
    assert client.get("/v1/jobs/job-0/events").status_code == 404


def test_news_arrive_while_they_happen(client: httpx.Client, worker: PretendWorker) -> None:
    job = submit(client)
    received: list[ServerSentEvent] = []
    thread = threading.Thread(target=worker.work)
    for event in follow(client, job):
        received.append(event)
        if event.event == "job.progress" and thread.ident is None:
            thread.start()
    thread.join()
    assert words(received) == ["queued", "running", "succeeded"]


def test_a_quiet_stream_says_that_it_lives_and_holds_no_connection(
    app: FastAPI, client: httpx.Client, worker: PretendWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sse, "KEEP_ALIVE_SECONDS", 0.3)
    job = submit(client)
    with client.stream("GET", f"/v1/jobs/{job}/events") as response:
        text = ""
        for piece in response.iter_text():
            text += piece
            if text.count(": still here\n\n") == 2:
                break
        # Each read of the feed borrows a connection for some milliseconds. A stream that held
        # a connection would keep it for as long as the stream is open.
        pool = app.state.context.database._reader.pool
        wait_until(lambda: pool.checkedout() == 0)
    assert text.startswith("retry: 1000\nid: 1\n")
    assert text.count("event: job.progress") == 1  # nothing has changed


def test_many_watchers_hear_the_end(client: httpx.Client, worker: PretendWorker) -> None:
    job = submit(client)
    ends: list[list[str]] = []
    threads = [
        threading.Thread(target=lambda: ends.append(words(list(follow(client, job)))))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    worker.work()
    for thread in threads:
        thread.join(20)
    assert [end[-1] for end in ends] == ["succeeded"] * 8


def test_watchers_share_one_look_at_the_database_and_miss_nothing(
    app: FastAPI,
    client: httpx.Client,
    worker: PretendWorker,
    monkeypatch: pytest.MonkeyPatch,
    clock: ManualClock,
) -> None:
    """Twenty watchers, each from another event on, while old events have left the feed's memory."""
    looks: list[int] = []

    def look(context: Context, connection: Any, job: int) -> Any:
        looks.append(job)
        return show_job(context, connection, job)

    monkeypatch.setattr(sse, "show_job", look)
    job = submit(client, gamma=(1.0, 2.0, 3.0))
    for _ in range(2):  # events of failed tries
        worker.report(*((lease, failure()) for lease in worker.lease(simulate=6)))
        clock.advance(5)
        sweep(app.state.context)
    known = [str(number) for number in range(1, 14)]
    heard: dict[str | None, list[str]] = {}

    def listen(last_id: str | None) -> None:
        heard[last_id] = [
            event.id for event in follow(client, job, last_id) if event.event != "job.progress"
        ]

    threads = [
        threading.Thread(target=listen, args=(last_id,))
        for last_id in (None, *known[::2], *known[1::2])
    ]
    for thread in threads:
        thread.start()
    for _ in range(3):
        clock.advance(5)
        worker.work()
    for thread in threads:
        thread.join(20)
    everything = heard[None]
    assert len(everything) > 14
    assert everything == sorted(set(everything), key=int)
    for last_id, ids in heard.items():
        assert ids == [number for number in everything if int(number) > int(last_id or 0)]
    assert len(looks) < len(threads) * 3
    assert app.state.feeds._feeds == {}  # nobody watches any more


@pytest.mark.parametrize("limit", ["MAX_OWN_STREAMS", "MAX_STREAMS"])
def test_an_address_has_only_so_many_streams_and_so_have_all(
    client: httpx.Client, worker: PretendWorker, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    monkeypatch.setattr(f"stickslip_services.api.sse.{limit}", 2)
    path = f"/v1/jobs/{client.post('/v1/jobs', json=rods(gamma=(77.0,))).json()['id']}/events"
    with client.stream("GET", path), client.stream("GET", path):
        for refused in (client.get(path), client.get("/ui/changes")):
            assert (refused.status_code, refused.json()["code"]) == (429, "too_many_streams")
        assert client.get("/v1/jobs").status_code == 200

    def is_free() -> bool:
        with client.stream("GET", path) as again:
            return again.status_code == 200

    wait_until(is_free)
