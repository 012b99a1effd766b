"""The REST interface: what it accepts, what it refuses and how, pages, idempotency."""

import json
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from stickslip_schemas.documents.worker_api import Heartbeat
from stickslip_services.app import make_app
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, rods
from stickslip_testing.servers import HttpApi, serving
from stickslip_testing.worker import DirectApi, PretendWorker, failure, rejection

pytestmark = pytest.mark.databases

JSON = {"Content-Type": "application/json"}


@pytest.fixture
def app(settings: Settings, clock: ManualClock) -> FastAPI:
    return make_app(settings, clock=clock)


@pytest.fixture
def client(app: FastAPI) -> Iterator[httpx.Client]:
    headers = {"Authorization": f"Bearer {app.state.worker_key}"}
    with serving(app) as url, httpx.Client(base_url=url, timeout=30, headers=headers) as client:
        yield client


@pytest.fixture
def worker(app: FastAPI, client: httpx.Client) -> PretendWorker:
    context = app.state.context
    return PretendWorker(DirectApi(context), context.store).register()


@pytest.fixture(scope="module")
def untouched(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[httpx.Client, PretendWorker]]:
    """A coordinator for requests that are all refused."""
    app = make_app(Settings(data=tmp_path_factory.mktemp("untouched"), durable=False))
    headers = {"Authorization": f"Bearer {app.state.worker_key}"}
    with serving(app) as url, httpx.Client(base_url=url, timeout=30, headers=headers) as client:
        context = app.state.context
        yield client, PretendWorker(DirectApi(context), context.store).register()


def problem(response: Any, status: int, code: str) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = response.json()
    assert (document["status"], document["code"]) == (status, code)
    assert document["request_id"] == response.headers["x-request-id"]
    return document


def with_axis(**axes: Any) -> dict[str, Any]:
    return {"kind": "rod_hang", "axes": {"gamma": [1.0], "phi0": [0.0], "phi1": [0.0]} | axes}


CLOTH_AXES = {"material": "gray-interlock", "mu": 0.2, "texture": "dots", "viewpoint": "left"}

MANY = {"type": "linspace", "start": 0, "stop": 9, "num": 10_000}

BAD_SPECS: dict[str, tuple[Any, str]] = {
    "unknown material": (
        {"kind": "cloth_drag", "axes": CLOTH_AXES | {"material": "silk"}},
        "/axes/material",
    ),
    "negative mu": ({"kind": "cloth_drag", "axes": CLOTH_AXES | {"mu": -0.1}}, "/axes/mu"),
    "empty axis": (with_axis(gamma=[]), "/axes/gamma"),
    "a value twice": (with_axis(gamma=[1.0, 1.0]), "/axes/gamma"),
    "a million million samples": (
        with_axis(
            **{
                name: {"type": "linspace", "start": 0, "stop": 9, "num": 10_000}
                for name in ("gamma", "phi0", "phi1")
            }
        ),
        "",
    ),
    "too many values": (
        with_axis(gamma={"type": "linspace", "start": 0, "stop": 9, "num": 10**12}),
        "/axes/gamma/num",
    ),
    "unknown field": (with_axis() | {"colour": "red"}, "/colour"),
    "unknown kind": (with_axis() | {"kind": "hair"}, ""),
    "no kind": ({"axes": {}}, ""),
    "missing axis": ({"kind": "rod_hang", "axes": {"gamma": 1.0, "phi0": 0.0}}, "/axes/phi1"),
    "huge integer": (with_axis() | {"seed": 10**400}, "/seed"),
    "huge number": (with_axis(gamma=10**400), "/axes/gamma"),
    "text for a number": (with_axis(gamma="1.0"), "/axes/gamma"),
    "true for a number": (with_axis(gamma=[True]), "/axes/gamma"),
    "a list": ([], ""),
    "null": (None, ""),
    "splits of more than all": (
        with_axis() | {"splits": {"train": 1.0, "validation": 1.0, "test": 0.0}},
        "/splits",
    ),
    "zipped axes of two lengths": (with_axis(gamma=[1.0, 2.0]) | {"combine": "zip"}, ""),
    "a name with a slash": (with_axis() | {"name": "../x"}, "/name"),
}


@pytest.mark.parametrize("case", BAD_SPECS)
@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs:validate"])
def test_a_bad_spec_is_refused_with_its_place(
    untouched: tuple[httpx.Client, PretendWorker], case: str, path: str
) -> None:
    client, worker = untouched
    spec, pointer = BAD_SPECS[case]
    response = client.post(path, content=json.dumps(spec), headers=JSON)
    document = problem(response, 422, "validation_failed")
    assert any(
        error["pointer"].startswith(pointer) and error["rule"] for error in document["errors"]
    )
    assert all(len(error["value"]) <= 200 for error in document["errors"])
    assert client.get("/v1/jobs").json()["items"] == []
    assert worker.lease() == ()


BAD_BODIES = {
    "cut": b'{"kind": "rod_hang"',
    "empty": b"",
    "nested": b"[" * 19_000,
    "nested objects": b'{"a":' * 19_000 + b"1" + b"}" * 19_000,
    "digits": b'{"seed": 1' + b"0" * 5000 + b"}",
    "latin-1": b'{"name": "\xe9"}',
    "surrogate": b'{"name": "\\ud800"}',
    "key twice": b'{"kind": "rod_hang", "kind": "cloth_drag"}',
    "a byte order mark": b'\xef\xbb\xbf{"kind": "rod_hang"}',
}


@pytest.mark.parametrize("case", BAD_BODIES)
@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/worker/report"])
def test_a_body_that_is_not_json_is_refused(
    untouched: tuple[httpx.Client, PretendWorker], case: str, path: str
) -> None:
    problem(untouched[0].post(path, content=BAD_BODIES[case], headers=JSON), 400, "malformed_body")


def test_a_key_twice_is_refused_in_a_message_that_is_right_otherwise(
    client: httpx.Client, worker: PretendWorker
) -> None:
    body = Heartbeat(worker_id=worker.id, leases=(), condition=worker.condition).model_dump_json()
    assert client.post("/v1/worker/heartbeat", content=body, headers=JSON).json() == {"drop": []}
    twice = body.replace('"leases":[]', '"leases":[],"leases":[]')
    problem(client.post("/v1/worker/heartbeat", content=twice, headers=JSON), 400, "malformed_body")


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e400"])
def test_a_number_that_is_not_finite_is_refused_with_its_place(
    client: httpx.Client, number: str
) -> None:
    body = json.dumps(with_axis()).replace("[1.0]", number).encode()
    document = problem(
        client.post("/v1/jobs", content=body, headers=JSON), 422, "validation_failed"
    )
    assert document["errors"][0]["pointer"] == "/axes/gamma"


def test_a_report_with_nan_in_its_labels_is_refused(client: httpx.Client) -> None:
    output = {
        "stage": "simulate",
        "record": {"digest": "0" * 64, "row": 0},
        "labels": {"energy": float("nan")},
    }
    report = {
        "task_id": "simulate-0",
        "token": 1,
        "result": {"outcome": "succeeded", "output": output},
    }
    body = json.dumps({"worker_id": "worker-0", "reports": [report]}).encode()
    problem(client.post("/v1/worker/report", content=body, headers=JSON), 400, "malformed_body")


@pytest.mark.parametrize(
    ("body", "rule"),
    [
        (
            json.dumps({"kind": "rod_hang"} | {f"key-{n}": 1 for n in range(60_000)}),
            "there is no such field",
        ),
        (
            "{" + ",".join(f'"key-{n}": 1' for n in range(60_000)) + ', "key-59999": 2}',
            "'key-59999' is there twice",
        ),
        ('{"axes":' * 19_000 + "1" + "}" * 19_000, "nested too deeply"),
    ],
    ids=["unknown", "doubled", "nested"],
)
def test_a_body_of_many_keys_is_refused_at_once(client: httpx.Client, body: str, rule: str) -> None:
    headers = {"Content-Type": "application/json"}
    before = time.process_time()
    answer = client.post("/v1/jobs", content=body, headers=headers)
    assert time.process_time() - before < 10.0  # it takes 0.5 s; the quadratic rule took minutes
    assert answer.status_code in (400, 422)
    assert rule in answer.text
    assert len(answer.content) < 50_000


def test_browsers_do_not_guess_types(client: httpx.Client) -> None:
    for path in ("/v1/jobs", "/", "/openapi.json", "/nowhere"):
        assert client.get(path).headers["X-Content-Type-Options"] == "nosniff"


def test_another_content_type_is_refused(client: httpx.Client) -> None:
    body = json.dumps(with_axis()).encode()
    problem(
        client.post("/v1/jobs", content=body, headers={"Content-Type": "text/plain"}),
        415,
        "malformed_body",
    )
    problem(client.post("/v1/jobs", content=body), 415, "malformed_body")
    assert client.post(
        "/v1/jobs", content=body, headers={"Content-Type": "application/json; charset=utf-8"}
    ).is_success


def test_a_large_body_is_refused(client: httpx.Client, settings: Settings) -> None:
    large = b" " * (settings.body_limit + 1)
    problem(client.post("/v1/jobs", content=large, headers=JSON), 413, "body_too_large")
    blocks = (b" " * 2**20 for _ in range(20))  # no Content-Length
    problem(client.post("/v1/jobs", content=blocks, headers=JSON), 413, "body_too_large")


def test_unknown_places_and_methods_are_problems(client: httpx.Client) -> None:
    problem(client.get("/v1/nothing"), 404, "not_found")
    problem(client.get("/v1/jobs/job-0"), 404, "not_found")
    problem(client.get("/v1/datasets/ds-0"), 404, "not_found")
    problem(client.get("/v1/tasks/simulate-0"), 404, "not_found")
    problem(client.get("/v1/previews/..%2f..%2fetc"), 404, "not_found")
    assert client.put("/v1/jobs").headers["allow"] == "GET, POST"
    assert client.get("/v1/jobs/job-0:cancel").status_code == 404
    assert client.options("/v1/jobs/job-0:cancel").headers["allow"] == "POST"
    problem(client.put("/v1/jobs"), 405, "method_not_allowed")
    problem(
        client.get("/v1/datasets/ds-0/versions/999999999999999999999"), 422, "validation_failed"
    )


def test_a_request_id_is_echoed(client: httpx.Client) -> None:
    assert (
        client.get("/livez", headers={"X-Request-Id": "mine-1"}).headers["x-request-id"] == "mine-1"
    )
    assert (
        client.get("/livez", headers={"X-Request-Id": "bad id!"}).headers["x-request-id"]
        != "bad id!"
    )


def test_a_job_is_accepted_and_shown(client: httpx.Client, worker: PretendWorker) -> None:
    response = client.post("/v1/jobs", json=rods(name="mine"))
    assert response.status_code == 202
    detail = client.get(response.headers["location"])
    assert detail.json() == response.json()
    worker.work()
    assert client.get(response.headers["location"]).json()["state"] == "succeeded"
    assert client.post(f"/v1/jobs/{detail.json()['id']}:cancel").status_code == 409


def test_a_problem_has_a_type_and_a_title_of_its_own(client: httpx.Client) -> None:
    document = problem(client.get("/v1/jobs/job-0"), 404, "not_found")
    assert (document["type"], document["title"]) == ("urn:stickslip:problem:not_found", "Not found")
    misspelt = client.post("/v1/jobs", json=with_axis() | {"qualty": "high"})
    assert "did you mean quality?" in problem(misspelt, 422, "validation_failed")["detail"]


def test_an_idempotency_key_makes_one_job(client: httpx.Client, worker: PretendWorker) -> None:
    headers = {"Idempotency-Key": "k1"}
    first = client.post("/v1/jobs", json=rods(), headers=headers)
    worker.work()
    again = client.post("/v1/jobs", json=rods(samples_per_shard=2), headers=headers)
    assert (first.status_code, again.status_code) == (202, 200)
    assert first.json() == again.json()
    assert first.headers["location"] == again.headers["location"]
    other = client.post("/v1/jobs", json=rods(gamma=(5.0,)), headers=headers)
    problem(other, 422, "idempotency_key_reused")
    assert len(client.get("/v1/jobs").json()["items"]) == 1
    problem(
        client.post("/v1/jobs", json=rods(), headers={"Idempotency-Key": "k" * 256}),
        422,
        "validation_failed",
    )


def test_a_kind_that_no_worker_makes_is_a_problem(
    client: httpx.Client, worker: PretendWorker
) -> None:
    response = client.post("/v1/jobs", json={"kind": "cloth_drag", "axes": CLOTH_AXES})
    problem(response, 409, "kind_not_available")


def test_validate_counts_what_is_there(app: FastAPI, client: httpx.Client) -> None:
    before = client.post("/v1/jobs:validate", json=rods()).json()
    assert (before["sample_count"], before["simulation_count"], before["cached_count"]) == (
        4,
        4,
        None,
    )
    context = app.state.context
    worker = PretendWorker(DirectApi(context), context.store).register()
    assert client.post("/v1/jobs:validate", json=rods()).json()["cached_count"] == 0
    client.post("/v1/jobs", json=rods())
    worker.work()
    after = client.post("/v1/jobs:validate", json=rods(gamma=(1.0, 2.0, 3.0))).json()
    assert (after["sample_count"], after["cached_count"]) == (6, 4 + 4 + 2)
    assert after["bytes_estimate"] > 6 * 4 * 224 * 224 * 3
    usual, costs = before["estimate"], after["estimate"]
    assert (usual["measured"], usual["wall_seconds"]) == ([], None)
    assert 0.1 < usual["cpu_seconds"]["median"] < 10
    # Two shards are too few to know the cost of packing. PretendWorker reports 2 s for each task.
    assert costs["measured"] == ["simulate", "render"]
    assert costs["cpu_seconds"]["median"] == pytest.approx(2 * (6 + 6), abs=1)
    assert costs["cpu_seconds"]["low"] < 24 < costs["cpu_seconds"]["high"]
    # Stages run one after the other, and shards are fewer than slots.
    assert costs["wall_seconds"]["median"] > costs["cpu_seconds"]["median"] / worker.slots
    assert len(client.get("/v1/jobs").json()["items"]) == 1


def test_pages_stay_what_they_are_while_jobs_come(client: httpx.Client) -> None:
    submitted = [
        client.post("/v1/jobs", json=rods(name=f"job{number}")).json()["id"] for number in range(5)
    ]
    page = client.get("/v1/jobs", params={"page_size": 2}).json()
    listed = [item["id"] for item in page["items"]]
    while page["next_page_token"]:
        client.post("/v1/jobs", json=rods())
        query = {"page_size": 2, "page_token": page["next_page_token"]}
        page = client.get("/v1/jobs", params=query).json()
        listed += [item["id"] for item in page["items"]]
    assert listed == submitted[::-1]


@pytest.mark.parametrize("token", ["x", "%", "LTE", "MTIzNDU2Nzg5MDEyMzQ1Njc4OTA", "é", ""])
def test_a_foreign_page_token_is_refused(
    untouched: tuple[httpx.Client, PretendWorker], token: str
) -> None:
    response = untouched[0].get("/v1/jobs", params={"page_token": token})
    problem(response, 422, "validation_failed")


def test_samples_are_listed_by_slot(client: httpx.Client, worker: PretendWorker) -> None:
    job = client.post("/v1/jobs", json=rods()).json()["id"]
    first = client.get(f"/v1/jobs/{job}/samples", params={"page_size": 3}).json()
    assert [(item["slot"], item["state"]) for item in first["items"]] == [
        (slot, "pending") for slot in range(3)
    ]
    query = {"page_size": 3, "page_token": first["next_page_token"]}
    rest = client.get(f"/v1/jobs/{job}/samples", params=query).json()
    assert [item["slot"] for item in rest["items"]] == [3]
    assert rest["items"][0]["labels"] == {"gamma": 2.0, "phi0": 0.0, "phi1": 3.0}
    assert rest["next_page_token"] is None
    problem(
        client.get(f"/v1/jobs/{job}/samples", params={"state": "odd"}), 422, "validation_failed"
    )


def test_previews_are_served_and_nothing_else_is(
    client: httpx.Client, worker: PretendWorker
) -> None:
    job = client.post("/v1/jobs", json=rods()).json()["id"]
    assert client.get(f"/v1/jobs/{job}/previews").json() == []
    worker.work()
    previews = client.get(f"/v1/jobs/{job}/previews").json()
    assert [item["slot"] for item in previews] == [0, 1, 2, 3]
    picture = client.get(previews[0]["href"])
    assert (picture.headers["content-type"], picture.content[:4]) == ("image/png", b"\x89PNG")
    manifest = client.get(f"/v1/jobs/{job}").json()["dataset"]["manifest"]
    problem(client.get(f"/v1/previews/{manifest}"), 404, "not_found")


def test_workers_are_listed(
    client: httpx.Client, worker: PretendWorker, clock: ManualClock
) -> None:
    client.post("/v1/jobs", json=rods())
    worker.lease(simulate=3)
    (entry,) = client.get("/v1/workers").json()
    assert (entry["name"], entry["alive"], entry["leased"]) == ("pretend", True, 3)
    clock.advance(60)
    assert client.get("/v1/workers").json()[0]["alive"] is False


def test_the_worker_api_speaks_in_problems(client: httpx.Client, worker: PretendWorker) -> None:
    body = {"worker_id": "worker-0", "wanted": {"simulate": 1}}
    problem(client.post("/v1/worker/lease", json=body), 404, "unknown_worker")
    body = {"worker_id": worker.id, "wanted": {"simulate": 10**30}}
    assert client.post("/v1/worker/lease", json=body).json()["leases"] == []
    PretendWorker(worker.api, worker.store).register()
    problem(client.post("/v1/worker/lease", json=body), 409, "conflict")
    report = {
        "worker_id": worker.id,
        "reports": [{"task_id": "nonsense", "token": 1, "result": None}],
    }
    assert client.post("/v1/worker/report", json=report).json()["verdicts"][0]["verdict"] == "stale"
    report["reports"] = [{"task_id": "simulate-" + "0" * 64, "token": 10**40, "result": None}]
    assert client.post("/v1/worker/report", json=report).json()["verdicts"][0]["verdict"] == "stale"


def test_health_and_metrics(client: httpx.Client, worker: PretendWorker) -> None:
    assert client.get("/livez").is_success
    assert client.get("/readyz").is_success
    client.post("/v1/jobs", json=rods())
    worker.lease(simulate=2)
    text = client.get("/metrics").text
    assert 'stickslip_tasks{stage="simulate",state="leased"} 2.0' in text
    assert 'stickslip_jobs{state="running"} 1.0' in text
    assert 'stickslip_leases{worker="pretend"} 2.0' in text
    assert (
        'stickslip_request_seconds_count{method="POST",route="/v1/jobs",status="202"} 1.0' in text
    )


def test_metrics_count_unknown_methods_as_one(client: httpx.Client) -> None:
    """Otherwise each word that a stranger sends as a method would stay in memory."""
    for word in ("BREW", "POUR"):
        client.request(word, "/v1/jobs")
    text = client.get("/metrics").text
    assert (
        'stickslip_request_seconds_count{method="other",route="/v1/jobs",status="405"} 2.0' in text
    )
    assert not any(word in text for word in ("BREW", "POUR"))


def test_metrics_tell_how_tasks_ended_and_what_is_stored(
    app: FastAPI, client: httpx.Client
) -> None:
    api = HttpApi(str(client.base_url), app.state.worker_key)

    def judge(task: Any) -> Any:
        if task.stage == "simulate" and task.simulation.gamma == 1.0:
            return rejection()
        return failure() if task.stage == "render" else None

    worker = PretendWorker(api, app.state.context.store, judge=judge).register()
    client.post("/v1/jobs", json=rods())
    worker.finish(*worker.lease())
    worker.finish(*worker.lease())
    text = client.get("/metrics").text
    assert 'stickslip_task_seconds_count{outcome="succeeded",stage="simulate"} 2.0' in text
    assert 'stickslip_task_seconds_sum{outcome="rejected",stage="simulate"} 2.0' in text
    assert (
        'stickslip_task_failures_total{outcome="rejected",reason="solver_diverged",'
        'stage="simulate"} 2.0' in text
    )
    assert (
        'stickslip_task_failures_total{outcome="failed",reason="renderer_crash",stage="render"} 2.0'
        in text
    )
    assert 'stickslip_disk_bytes{place="store",state="free"}' in text
    assert "stickslip_dataset_versions 0.0" in text
    assert 'stickslip_info{version="' in text


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "example.org", ""])
def test_other_addresses_than_loopback_are_refused(host: str) -> None:
    with pytest.raises(ValueError, match="host must be a loopback address"):
        Settings(host=host)


def test_a_job_has_a_priority_that_can_be_changed(client: httpx.Client) -> None:
    job = client.post("/v1/jobs", params={"priority": 7}, json=rods()).json()
    assert job["priority"] == 7
    changed = client.patch(f"/v1/jobs/{job['id']}", json={"priority": -3})
    assert (changed.status_code, changed.json()["priority"]) == (200, -3)
    assert client.get(f"/v1/jobs/{job['id']}").json()["priority"] == -3
    assert client.get("/v1/jobs").json()["items"][0]["priority"] == -3
    problem(client.patch("/v1/jobs/job-0", json={"priority": 1}), 404, "not_found")
    for wrong in ({"priority": 101}, {"priority": 1.5}, {}, {"priority": 1, "state": "failed"}):
        problem(client.patch(f"/v1/jobs/{job['id']}", json=wrong), 422, "validation_failed")
    problem(
        client.post("/v1/jobs", params={"priority": 101}, json=rods()), 422, "validation_failed"
    )
    client.post(f"/v1/jobs/{job['id']}:cancel")
    problem(client.patch(f"/v1/jobs/{job['id']}", json={"priority": 1}), 409, "conflict")


def test_workers_show_what_they_run_and_how_far_it_is(
    client: httpx.Client, worker: PretendWorker
) -> None:
    job = client.post("/v1/jobs", json=rods()).json()["id"]
    running, _ = worker.lease(simulate=2)
    state = {
        "task_id": running.task_id,
        "token": running.token,
        "started": True,
        "frames": [40, 300],
    }
    client.post(
        "/v1/worker/heartbeat",
        json={"worker_id": worker.id, "leases": [state], "condition": {"slots": 2}},
    ).raise_for_status()
    (entry,) = client.get("/v1/workers").json()
    assert entry["leased"] == 2
    (task,) = entry["running"]
    assert (task["task_id"], task["stage"], task["job"], task["frames"]) == (
        running.task_id,
        "simulate",
        job,
        [40, 300],
    )
    assert "40 of 300" in client.get("/workers").text
    assert client.get(f"/v1/jobs/{job}").json()["progress"]["stages"]["simulate"]["frames"] == [
        40,
        300,
    ]
