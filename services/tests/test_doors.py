"""Who may come in: foreign names, pages of other sites, workers without the key."""

import stat
from collections.abc import Iterator

import httpx
import pytest
from fastapi import FastAPI
from stickslip_services.coordinator import make_app
from stickslip_services.settings import Settings
from stickslip_services.testing import rods, serving

WORKER_PATHS = ("/v1/workers", "/v1/worker/lease", "/v1/worker/heartbeat", "/v1/worker/report")


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    data = tmp_path_factory.mktemp("doors")
    return make_app(Settings(data=data, durable=False, allowed_hosts=("farm.example",)))


@pytest.fixture(scope="module")
def client(app: FastAPI) -> Iterator[httpx.Client]:
    with serving(app) as url, httpx.Client(base_url=url, timeout=20) as client:
        yield client


@pytest.mark.parametrize(
    "host", ["evil.com", "evil.com:8765", "10.0.0.1", "localhost.evil.com", "", "[", "127.0.0.1@evil.com"]
)
def test_foreign_names_are_refused(client: httpx.Client, host: str) -> None:
    for path in ("/", "/v1/jobs", "/static/app.css"):
        response = client.get(path, headers={"Host": host})
        if host == "[":  # no URL at all: the server itself may refuse it
            assert response.status_code in (400, 403)
            continue
        assert (response.status_code, response.json()["code"]) == (403, "host_not_allowed"), (path, response.text)


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8765", "localhost", "[::1]:80", "127.3.2.1", "farm.example", "farm.example:443"]
)
def test_own_names_are_let_in(client: httpx.Client, host: str) -> None:
    assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("origin", ["https://evil.com", "http://127.0.0.1:1", "null", "http://localhost"])
def test_pages_of_other_sites_change_nothing(client: httpx.Client, origin: str) -> None:
    for path in ("/v1/jobs", "/v1/jobs/job-0:cancel", "/ui/jobs/job-0/cancel"):
        response = client.post(path, headers={"Origin": origin}, json=rods())
        assert (response.status_code, response.json()["code"]) == (403, "origin_not_allowed")
    assert client.get("/v1/jobs").json()["items"] == []


def test_own_pages_do(client: httpx.Client) -> None:
    origin = str(client.base_url).rstrip("/")
    assert client.post("/v1/jobs:validate", headers={"Origin": origin}, json=rods()).status_code == 200


@pytest.mark.parametrize("path", WORKER_PATHS)
@pytest.mark.parametrize("key", [None, "", "Bearer", "Bearer wrong", "Basic {key}", "{key}", "Bearer {key}x"])
def test_workers_need_the_key(client: httpx.Client, app: FastAPI, path: str, key: str | None) -> None:
    headers = {} if key is None else {"Authorization": key.format(key=app.state.worker_key)}
    response = client.post(path, headers=headers, json={"worker_id": "x", "name": "x"})
    assert (response.status_code, response.json()["code"]) == (401, "unauthorized")
    assert "worker-key" in response.json()["detail"]
    assert response.headers["www-authenticate"].startswith("Bearer")


def test_the_key_lets_them_in(client: httpx.Client, app: FastAPI) -> None:
    headers = {"Authorization": f"Bearer {app.state.worker_key}"}
    response = client.post("/v1/worker/heartbeat", headers=headers, json={"worker_id": "x", "leases": []})
    assert (response.status_code, response.json()["code"]) == (404, "unknown_worker")
    assert client.get("/v1/workers").status_code == 200  # looking is for everybody


def test_only_its_owner_reads_the_key(app: FastAPI, client: httpx.Client) -> None:
    settings = app.state.coordinator.settings
    path = settings.worker_key_path
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert len(path.read_text().strip()) >= 40
    assert make_app(settings).state.worker_key == app.state.worker_key  # it survives a restart
