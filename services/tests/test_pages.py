"""The dashboard: every page answers, shows what it should, escapes what it is given, and changes
jobs.
"""

import asyncio
import csv
import html
import json
import re
from collections.abc import Iterator
from io import BytesIO
from typing import Any
from zipfile import ZipFile

import httpx
import numpy as np
import pytest
import yaml
from fastapi import FastAPI
from PIL import Image
from stickslip_schemas.base import JobState
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene, scene_names
from stickslip_services.api.routes.pages.jobs import _changes
from stickslip_services.app import make_app
from stickslip_services.pages.rendering import _environment, plot, table
from stickslip_services.queue.background import sweep
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker, failure, rejection


@pytest.fixture
def app(settings: Settings, clock: ManualClock) -> FastAPI:
    return make_app(settings, clock=clock)


@pytest.fixture
def client(app: FastAPI) -> Iterator[httpx.Client]:
    with (
        serving(app) as url,
        httpx.Client(base_url=url, timeout=20, follow_redirects=True) as client,
    ):
        yield client


@pytest.fixture
def worker(app: FastAPI, client: httpx.Client) -> PretendWorker:
    return PretendWorker(
        DirectApi(app.state.context), app.state.context.store, whole=True
    ).register()


GAMMA = [1.0, 2.0, 3.0]


def submit(client: httpx.Client, **spec: Any) -> str:
    response = client.post("/v1/jobs", json=rods(**spec))
    assert response.status_code == 202, response.text
    return str(response.json()["id"])


def read(client: httpx.Client, path: str) -> str:
    response = client.get(path)
    assert response.status_code == 200, (path, response.text)
    assert response.headers["content-type"].startswith("text/html")
    assert "script-src 'self'" in response.headers["content-security-policy"]
    assert not re.search(r"(src|href)=\"(https?:)?//", response.text), "everything comes from here"
    return response.text


def test_empty_pages_say_what_to_do(client: httpx.Client) -> None:
    assert "stickslip submit spec.yaml" in read(client, "/")
    assert "No worker is connected" in read(client, "/")
    assert "There are no datasets yet" in read(client, "/datasets")
    assert "stickslip certify" in read(client, "/certificates")
    workers = read(client, "/workers")
    assert "stickslip up" in workers
    assert re.search(r"This machine has [\d.]+ [MG]B of its [\d.]+ GB of memory free", workers)
    assert "/v1/jobs:validate" in read(client, "/docs")


def test_a_job_from_queue_to_dataset(client: httpx.Client, worker: PretendWorker) -> None:
    job = submit(client, name="first", gamma=GAMMA)
    assert "first" in read(client, "/")
    leases = worker.lease(simulate=1)
    worker.start(*leases)
    assert "simulate" in read(client, "/workers")
    assert job in read(client, "/workers")
    worker.finish(*leases)
    assert "have been read since" not in read(client, "/workers")
    worker.work()
    assert re.search(
        r"All datasets have been read since 20[\d: -]+ UTC: 0 files were damaged",
        read(client, "/workers"),
    )
    page = read(client, f"/jobs/{job}")
    assert "succeeded" in page
    assert "stickslip pull ds-" in page
    assert "samples_per_shard: 2" in page
    assert page.count("/v1/previews/") == 6
    assert "gamma 1, phi1 1: 1 of 1 done" in read(client, f"/ui/jobs/{job}/map")
    slowest = read(client, f"/ui/jobs/{job}/slowest")
    assert slowest.count(f"/jobs/{job}/tasks/") == 8
    assert slowest.count("<td>1.0 s</td><td>2.0 s</td>") == 8  # PretendWorker reports so much each
    assert re.search(r"<dt>ended</dt><dd>20[\d: -]+ UTC</dd>", page)
    assert re.search(r"<dt>wall time</dt><dd>[\d.]+ s</dd>", page)
    assert re.search(r"\(without cached tasks usually about [\d.]+ s, ", page)
    assert "so far" not in page
    assert "6 of 6 (100 %)" in page
    path = re.search(r"/datasets/ds-[0-9a-f]+/v1", page)
    assert path is not None
    assert page.count(f'<a href="{path[0]}/samples/') == 6
    dataset = read(client, path[0])
    assert f'<a href="/jobs/{job}">first</a>' in dataset
    assert dataset.count("/samples/") >= 6
    assert "accepted" not in dataset  # nothing was lost
    assert "DatasetReader" in dataset
    assert "energy" in dataset
    assert "6 of 6 samples" in dataset
    thumbs = read(client, f"/ui{path[0]}/thumbs?gamma.from=1&gamma.to=1")
    assert "2 of 6 samples" in thumbs
    sample = read(client, f"{path[0]}/samples/3")
    assert f'<a href="/jobs/{job}">Its job</a>' in sample
    assert "twist" in html.unescape(sample.partition('data-plot="')[2])
    assert "curvature" in sample
    assert f'data-motion="/ui{path[0]}/samples/3/motion.json"' in sample
    picture = client.get(f"/ui{path[0]}/samples/3/views/2.png")
    assert picture.headers["content-type"] == "image/png"
    again = client.get(
        f"/ui{path[0]}/samples/3/views/2.png", headers={"If-None-Match": picture.headers["etag"]}
    )
    assert (again.status_code, again.content) == (304, b"")
    pixels = np.asarray(Image.open(BytesIO(picture.content)))
    stored = (
        np.arange(4 * pixels.size).reshape(4, *pixels.shape) + 3
    ) % 251  # as PretendWorker fills it
    assert (pixels == stored[2]).all()
    motion = client.get(f"/ui{path[0]}/samples/3/motion.json").json()
    (rod,) = motion["sheets"]
    assert (np.shape(rod["points"]), motion["bodies"], motion["holders"]) == ((1, 450), [], [])
    both = read(client, f"{path[0]}/samples/3?beside=1")
    assert "Sample 3 and sample 1" in both
    assert both.count("motion.json") == 2
    # The curves of both are in one plot.
    assert both.count("data-plot=") == 1
    assert "sample 3: " in html.unescape(both)
    assert "sample 1: " in html.unescape(both)
    assert "Labels that differ" in both
    assert '/files/views/c/1/0/0/0/0" download' in both
    assert parsed(yaml.safe_load(client.get(f"/ui{path[0]}/spec.yaml").text)) == parsed(
        rods(name="first", gamma=GAMMA)
    )
    assert client.get(f"{path[0]}/samples/3?beside=99").status_code == 404
    assert client.get(f"/ui{path[0]}/samples/99/motion.json").status_code == 404
    for missing in ("samples/99", "samples/-1"):
        assert client.get(f"{path[0]}/{missing}").status_code == 404
    for missing in ("3/nothing/0.png", "3/views/9.png", "3/views.mp4", "3/energy/0.png"):
        assert client.get(f"/ui{path[0]}/samples/{missing}").status_code == 404
    assert read(client, re.sub("/v1$", "", path[0])) == dataset


def test_what_was_lost_is_shown(client: httpx.Client, worker: PretendWorker) -> None:
    worker.judge = lambda task: (
        rejection("it fell <b>off</b>")
        if task.stage == "simulate" and task.simulation.gamma == 1.0
        else None
    )
    job = submit(client)
    worker.work()
    page = read(client, f"/jobs/{job}")
    assert "it fell &lt;b&gt;off&lt;/b&gt;" in page
    path = re.search(r"/datasets/ds-[0-9a-f]+/v1", page)
    assert path is not None
    dataset = read(client, path[0])
    assert "(50.0 %)" in dataset
    assert "<td>50.0 %</td>" in dataset
    assert "gamma 1, phi1 1: 0 of 1 done, 1 lost" in dataset
    counts = [
        re.findall(r"(\d) of 4 samples", read(client, f"{path[0]}?valid={value}"))
        for value in ("yes", "no", "")
    ]
    assert counts == [["2"], ["2"], ["4"]]
    assert "0 of 4 samples" in read(client, f"{path[0]}?gamma.from=1&gamma.to=0")
    condition = "where0.label=gamma&where0.operator=>&where0.value=1.5"
    assert "2 of 4 samples" in read(client, f"{path[0]}?{condition}")
    assert "gamma must be compared" in read(client, f"{path[0]}?{condition[:-3]}much")
    assert "option selected>train" in read(client, f"{path[0]}?split=train")
    assert "gamma 2, phi1 1: 1 of 1 done<" in dataset
    assert "it fell &lt;b&gt;off&lt;/b&gt;" in dataset
    assert "Sample 0 was rejected: solver diverged" in read(client, f"{path[0]}/samples/0")
    beside = read(client, f"{path[0]}/samples/0?beside=3")
    assert ("Sample 0 was rejected" in beside, beside.count("motion.json")) == (True, 1)


def test_samples_of_two_datasets_are_compared(client: httpx.Client, worker: PretendWorker) -> None:
    for name, gamma in (("first", (1.0, 2.0)), ("second", (3.0, 4.0))):
        client.post("/v1/jobs", json=rods(name=name, gamma=gamma)).raise_for_status()
        worker.work()
    newest = client.get("/v1/datasets").json()["items"]
    places = {entry["name"]: f"{entry['id']}:v1" for entry in newest}
    page = f"/datasets/{places['first'].replace(':', '/')}/samples/1"
    alone = html.unescape(read(client, page))
    assert f'<option value="{places["second"]}">second, version 1' in alone
    assert f'<option value="{places["first"]}"' not in alone

    both = html.unescape(read(client, f"{page}?beside=0&of={places['second']}"))
    assert "Sample 1 of first, version 1 and sample 0 of second, version 1" in both
    assert f'<option value="{places["second"]}" selected>' in both
    for title in ("sample 1 of first, version 1", "sample 0 of second, version 1"):
        assert f'"{title}: ' in both
    assert both.count("data-plot=") == 1
    rows = re.findall(r"<dt>gamma</dt><dd>([\d.]+)</dd><dd>([\d.]+)", both)
    assert rows == [("1", "3")]  # slot 1 has the first gamma and the second phi1
    second = places["second"].replace(":", "/")
    assert f'data-motion="/ui/datasets/{second}/samples/0/motion.json"' in both

    for wrong in ("ds-0000000000000000:v1", f"{places['second']}9", "second", ":v", "a:vb"):
        assert client.get(f"{page}?beside=0&of={wrong}").status_code == 404
    assert client.get(f"{page}?beside=9&of={places['second']}").status_code == 404


def test_what_failed_is_shown_with_its_reproducer(
    client: httpx.Client, worker: PretendWorker, clock: ManualClock, app: FastAPI
) -> None:
    worker.judge = lambda _task: failure(message="it crashed at line 7")
    job = submit(client, gamma=(1.0,), phi1=(1.0,))
    for _ in range(4):
        worker.work()
        clock.advance(10)
        sweep(app.state.context)
    page = read(client, f"/jobs/{job}")
    assert "it crashed at line 7" in page
    assert "quarantined: 1 of the newest 1" in page
    assert "No task of this job has ended yet" in read(client, f"/ui/jobs/{job}/slowest")
    assert "python -m stickslip_workers replay" in page


def test_names_cannot_break_out(client: httpx.Client) -> None:
    name = "<script>alert(1)</script>"
    response = client.post("/v1/jobs", json=rods(name=name))
    if response.status_code == 422:  # names are restricted: nothing to escape
        return
    assert name not in read(client, "/")


def test_buttons_change_jobs(client: httpx.Client, worker: PretendWorker, app: FastAPI) -> None:
    job = submit(client)
    context = app.state.context
    for verb, state in (
        ("pause", JobState.paused),
        ("resume", JobState.queued),
        ("cancel", JobState.cancelled),
    ):
        assert f"/ui/jobs/{job}/{verb}" in read(client, "/")
        answer = client.post(f"/ui/jobs/{job}/{verb}")
        assert (answer.status_code, answer.headers["hx-redirect"]) == (204, f"/jobs/{job}")
        assert show_job(context, job).state is state
    again = client.post(f"/ui/jobs/{job}/resubmit").headers["hx-redirect"].rpartition("/")[2]
    assert again != job
    worker.work()
    assert show_job(context, again).state is JobState.succeeded
    assert client.post(f"/ui/jobs/{job}/explode").status_code == 404
    assert client.post("/ui/jobs/job-0/pause").status_code == 404


def test_a_page_is_told_of_changes(app: FastAPI, client: httpx.Client) -> None:
    change = b"event: change\ndata: {}\n\n"

    async def follow() -> None:
        stream = _changes(app.state.context)
        assert await anext(stream) == b"retry: 2000\n\n"
        assert await anext(stream) == change  # at once, for what happened before
        app.state.context.notifier.notify()  # while it pauses
        assert await asyncio.wait_for(anext(stream), 5) == change
        following = asyncio.ensure_future(anext(stream))
        await asyncio.sleep(1.2)
        assert not following.done()
        app.state.context.notifier.notify()
        assert await asyncio.wait_for(following, 5) == change

    asyncio.run(follow())


def test_assets_are_local_and_licensed(client: httpx.Client) -> None:
    for name in ("app.css", "app.js", "space.js", "icon.svg"):
        assert client.get(f"/static/{name}").status_code == 200
    for library, licence in (
        ("htmx", "Zero-Clause BSD"),
        ("three", "MIT License"),
        ("uplot", "MIT License"),
    ):
        assert licence in client.get(f"/static/{library}-LICENSE.txt").text
        assert client.get(f"/static/{library}.min.js").status_code == 200
    assert client.get("/static/../app.py").status_code == 404


def test_a_plot_escapes_names_and_leaves_gaps_where_nothing_is_known() -> None:
    drawing = plot(table([0.0, 1.0], {'"><b>': [1.0, float("nan")]}), x_name="t", y_name="y")
    text = (
        _environment()
        .from_string('{% from "macros.html" import plot %}{{ plot(made) }}')
        .render(made=drawing)
    )
    assert "<b>" not in text
    match = re.search('data-plot="([^"]*)"', text)
    assert match is not None
    assert json.loads(html.unescape(match[1]))["tables"][0]["curves"] == {'"><b>': [1.0, None]}


def test_scenes_have_pages_with_their_parameters(client: httpx.Client) -> None:
    listed = read(client, "/scenes")
    digest = load_scene("turning-ball").digest
    assert f'<a href="/scenes/{digest}">turning-ball</a>' in listed
    page = read(client, f"/scenes/{digest}")
    assert "stickslip scene preview turning-ball preview" in page
    match = re.search(r">scene.yaml</p>.*?<pre[^>]*>(.*?)</pre>", page, re.DOTALL)
    assert match is not None
    assert Scene.model_validate(yaml.safe_load(html.unescape(match[1]))).digest == digest
    for name in scene_names():
        picture = client.get(f"/static/scenes/{name}.webp")
        assert Image.open(BytesIO(picture.content)).size == (640, 160)
        assert f"/static/scenes/{name}.webp" in listed
    assert all(name in page for name in ("mu", "speed", "rad/s", "bodies.ball.motion.spin.speed"))
    assert client.get(f"/scenes/{'0' * 64}").status_code == 404


def test_a_scene_of_a_job_is_listed(app: FastAPI, client: httpx.Client) -> None:
    context = app.state.context
    PretendWorker(DirectApi(context), context.store, kinds=("cloth_scene",)).register()
    axes = {"texture": "dots", "viewpoint": "front"}
    scene = load_scene("turning-ball").model_dump(mode="json") | {
        "name": "my-ball",
        "description": "<b>mine</b>",
    }
    spec = {"kind": "cloth_scene", "scene": scene, "axes": axes, "allow_uncertified": True}
    assert client.post("/v1/jobs", json=spec).status_code == 202
    match = re.search(r'href="(/scenes/[0-9a-f]{64})">my-ball<', read(client, "/scenes"))
    assert match
    assert "&lt;b&gt;mine&lt;/b&gt;" in read(client, match[1])


def test_jobs_are_searched_filtered_and_ordered(client: httpx.Client, app: FastAPI) -> None:
    first, second = submit(client, name="first"), submit(client, name="second", gamma=(3.0,))
    client.post(f"/ui/jobs/{second}/cancel")

    def listed(query: str) -> list[str]:
        return re.findall(r'<a href="/jobs/(job-[0-9a-z]+)">', read(client, f"/?{query}"))

    assert listed("") == [second, first]
    assert listed("order=oldest") == [first, second]
    assert listed("search=SECO") == listed("state=cancelled") == [second]
    assert listed(f"search={first[-6:]}&state=&project=") == [first]
    assert listed("search=%25") == []
    assert "No job fits" in read(client, "/?search=third")
    assert 'value="cancelled" selected' in read(client, "/?state=cancelled")
    assert client.get("/?state=odd").status_code == 422
    response = client.get("/v1/jobs", params={"search": "first", "state": "queued"}).json()["items"]
    assert [job["id"] for job in response] == [first]


def test_a_browser_gets_errors_as_a_page(client: httpx.Client) -> None:
    page = client.get("/jobs/<b>", headers={"Accept": "text/html,*/*"})
    assert (page.status_code, page.headers["content-type"]) == (404, "text/html; charset=utf-8")
    assert "there is no job &#39;&lt;b&gt;&#39;" in page.text
    assert client.get("/nowhere", headers={"Accept": "text/html"}).text.startswith(
        "<!doctype html>"
    )
    for path in ("/jobs/nothing", "/v1/jobs/nothing"):
        assert client.get(path).headers["content-type"] == "application/problem+json"


def test_chosen_samples_come_as_a_zip(client: httpx.Client, worker: PretendWorker) -> None:
    worker.judge = lambda task: (
        rejection() if getattr(getattr(task, "simulation", None), "gamma", 0) == 1.0 else None
    )
    submit(client, name="zipped", gamma=GAMMA)
    worker.work()
    (dataset,) = client.get("/v1/datasets").json()["items"]
    root = f"/ui/datasets/{dataset['id']}/v1"
    page = read(client, f"{root}/thumbs?where0.label=gamma&where0.operator=<&where0.value=2.5")
    assert f"{root}/selection.zip?&amp;where0.label=gamma&amp;where0.operator=%3C" in page
    assert "--where &#39;gamma&lt;2.5&#39;" in page
    answer = client.get(f"{root}/selection.zip?where0.label=gamma&where0.operator=<&where0.value=3")
    assert 'filename="zipped-v1.zip"' in answer.headers["content-disposition"]
    with ZipFile(BytesIO(answer.content)) as file:
        assert file.testzip() is None
        rows = list(csv.DictReader(file.read("labels.csv").decode().splitlines()))
        assert [(row["slot"], float(row["gamma"])) for row in rows] == [("2", 2.0), ("3", 2.0)]
        views = np.load(BytesIO(file.read("views/0000003.npy")))
        assert views.shape == (4, 224, 224, 3)
        assert not [name for name in file.namelist() if name.endswith(("0000000.npy", "1.npy"))]
    # Without a filter, rejected samples are left out too.
    with ZipFile(BytesIO(client.get(f"{root}/selection.zip").content)) as file:
        assert len(file.read("labels.csv").decode().splitlines()) == 1 + 4


def test_samples_are_sorted_and_shown_in_parts(client: httpx.Client, worker: PretendWorker) -> None:
    axis = {"type": "linspace", "start": 1.0, "stop": 60.0, "num": 60}
    submit(client, name="many", gamma=axis, phi1=(1.0, 2.0))
    worker.work()
    (dataset,) = client.get("/v1/datasets").json()["items"]
    root = f"/ui/datasets/{dataset['id']}/v1"

    def slots(query: str) -> list[int]:
        return [int(slot) for slot in re.findall(r"/samples/(\d+)\">", read(client, root + query))]

    assert slots("/thumbs") == list(range(48))
    assert slots("/thumbs?sort=gamma&order=descending")[:4] == [118, 119, 116, 117]
    last = read(client, f"{root}/thumbs?sort=gamma&order=descending&start=96")
    assert "Back to the first" in last
    assert "Jump to the last" not in last
    assert slots("/thumbs?sort=gamma&order=descending&start=96")[-2:] == [0, 1]
    first = read(client, f"{root}/thumbs")
    assert f'hx-get="{root}/thumbs?start=96"' in first
    assert client.get(f"{root}/thumbs?start=48&part=more").text.count("<li") == 48
    page = read(client, f"/datasets/{dataset['id']}/v1")
    assert f"/v1/datasets/{dataset['id']}/versions/1/files/views/c/0/0/0/0/0" in page
    assert 'download="views-c-0-0-0-0-0"' in page


def test_datasets_are_searched(client: httpx.Client, worker: PretendWorker) -> None:
    for number, name in enumerate(("alpha", "beta")):
        submit(client, name=name, gamma=(float(number + 1),))
    worker.work()

    def listed(query: str) -> list[str]:
        return re.findall(r'/v1">([a-z]+)</a>', read(client, f"/datasets?{query}"))

    assert listed("") == ["beta", "alpha"]
    assert listed("order=oldest") == ["alpha", "beta"]
    assert listed("search=ALPH") == ["alpha"]
    assert listed("search=rod_hang") == ["beta", "alpha"]
    assert "No dataset fits" in read(client, "/datasets?search=gamma%25")
    (first, _) = client.get("/v1/datasets").json()["items"]
    cover = client.get(f"/ui/datasets/{first['id']}/v1/cover.png")
    assert Image.open(BytesIO(cover.content)).size == (56, 56)
