"""Who may come in: foreign names, pages of other sites, requests without a key or with one for
something else.
"""

import ssl
import stat
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from click.testing import CliRunner
from fastapi import FastAPI
from pydantic import ValidationError
from stickslip_services.access.keys import create_key, list_keys, revoke_key
from stickslip_services.access.principals import Scope
from stickslip_services.api.middleware import needed_scope
from stickslip_services.app import main, make_app
from stickslip_services.cli import app as cli
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving, start_server, wait_until

WORKER_PATHS = ("/v1/workers", "/v1/worker/lease", "/v1/worker/heartbeat", "/v1/worker/report")


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    data = tmp_path_factory.mktemp("auth")
    return make_app(Settings(data=data, durable=False, allowed_hosts=("farm.example",)))


@pytest.fixture(scope="module")
def client(app: FastAPI) -> Iterator[httpx.Client]:
    with serving(app) as url, httpx.Client(base_url=url, timeout=20) as client:
        yield client


@pytest.mark.parametrize(
    "host",
    ["evil.com", "evil.com:8765", "10.0.0.1", "localhost.evil.com", "", "[", "127.0.0.1@evil.com"],
)
def test_foreign_names_are_refused(client: httpx.Client, host: str) -> None:
    for path in ("/", "/v1/jobs", "/static/app.css"):
        response = client.get(path, headers={"Host": host})
        if host == "[":  # no URL at all: the server itself may refuse it
            assert response.status_code in (400, 403)
            continue
        assert (response.status_code, response.json()["code"]) == (403, "host_not_allowed"), (
            path,
            response.text,
        )


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8765", "localhost", "[::1]:80", "127.3.2.1", "farm.example", "farm.example:443"],
)
def test_own_names_are_let_in(client: httpx.Client, host: str) -> None:
    assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "origin", ["https://evil.com", "http://127.0.0.1:1", "null", "http://localhost"]
)
def test_pages_of_other_sites_change_nothing(client: httpx.Client, origin: str) -> None:
    for path in ("/v1/jobs", "/v1/jobs/job-0:cancel", "/ui/jobs/job-0/cancel"):
        response = client.post(path, headers={"Origin": origin}, json=rods())
        assert (response.status_code, response.json()["code"]) == (403, "origin_not_allowed")
    assert client.get("/v1/jobs").json()["items"] == []


def test_own_pages_do(client: httpx.Client) -> None:
    origin = str(client.base_url).rstrip("/")
    assert (
        client.post("/v1/jobs:validate", headers={"Origin": origin}, json=rods()).status_code == 200
    )


@pytest.mark.parametrize("path", WORKER_PATHS)
@pytest.mark.parametrize(
    "key", [None, "", "Bearer", "Bearer wrong", "Basic {key}", "{key}", "Bearer {key}x"]
)
def test_workers_need_the_key(
    client: httpx.Client, app: FastAPI, path: str, key: str | None
) -> None:
    headers = {} if key is None else {"Authorization": key.format(key=app.state.worker_key)}
    response = client.post(path, headers=headers, json={"worker_id": "x", "name": "x"})
    assert (response.status_code, response.json()["code"]) == (401, "unauthorized")
    assert "worker-key" in response.json()["detail"]
    assert response.headers["www-authenticate"].startswith("Bearer")


def test_the_key_lets_them_in(client: httpx.Client, app: FastAPI) -> None:
    headers = {"Authorization": f"Bearer {app.state.worker_key}"}
    response = client.post(
        "/v1/worker/heartbeat",
        headers=headers,
        json={"worker_id": "x", "leases": [], "condition": {"slots": 2}},
    )
    assert (response.status_code, response.json()["code"]) == (404, "unknown_worker")
    assert client.get("/v1/workers").status_code == 200  # looking is for everybody


def test_only_its_owner_reads_the_key(app: FastAPI, client: httpx.Client) -> None:
    settings = app.state.context.settings
    path = settings.worker_key_path
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert len(path.read_text().strip()) >= 40
    assert make_app(settings).state.worker_key == app.state.worker_key  # it survives a restart


# --- keys
# ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    """A coordinator that asks everybody for a key."""
    return make_app(
        Settings(data=tmp_path_factory.mktemp("closed"), durable=False, require_keys=True)
    )


@pytest.fixture(scope="module")
def stranger(closed: FastAPI) -> Iterator[httpx.Client]:
    with serving(closed) as url, httpx.Client(base_url=url, timeout=20) as client:
        yield client


@pytest.fixture(scope="module")
def secrets_(closed: FastAPI, stranger: httpx.Client) -> dict[Scope, str]:
    with closed.state.context.database.write() as connection:
        return {scope: create_key(connection, scope, [scope], time.time())[1] for scope in Scope}


REQUESTS = {
    ("GET", "/"): Scope.read,
    ("GET", "/v1/jobs"): Scope.read,
    ("GET", "/v1/jobs/job-0"): Scope.read,
    ("GET", "/v1/workers"): Scope.read,
    ("GET", "/metrics"): Scope.read,
    ("GET", "/openapi.json"): Scope.read,
    ("POST", "/v1/jobs:validate"): Scope.read,
    ("POST", "/v1/jobs"): Scope.submit,
    ("PATCH", "/v1/jobs/job-0"): Scope.submit,
    ("POST", "/v1/jobs/job-0:cancel"): Scope.submit,
    ("POST", "/ui/jobs/job-0/cancel"): Scope.submit,
    ("DELETE", "/no/such/route"): Scope.submit,
    ("POST", "/v1/certificates"): Scope.admin,
    **{("POST", path): Scope.work for path in WORKER_PATHS},
}
INCLUDED = {
    Scope.read: {Scope.read},
    Scope.submit: {Scope.read, Scope.submit},
    Scope.work: {Scope.work},
    Scope.admin: set(Scope),
}


@pytest.mark.parametrize(("method", "path"), REQUESTS)
@pytest.mark.parametrize("scope", Scope)
def test_each_request_needs_its_scope(
    stranger: httpx.Client, secrets_: dict[Scope, str], method: str, path: str, scope: Scope
) -> None:
    response = stranger.request(
        method, path, headers={"Authorization": f"Bearer {secrets_[scope]}"}
    )
    if REQUESTS[method, path] in INCLUDED[scope]:
        assert response.status_code not in (401, 403), response.text
        return
    assert (response.status_code, response.json()["code"]) == (403, "scope_missing")
    assert response.json()["detail"].startswith(
        f"the request needs the scope `{REQUESTS[method, path]}`"
    )
    assert response.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(("method", "path"), REQUESTS)
@pytest.mark.parametrize(
    "authorization", [None, "Bearer wrong", "Basic wrong", "Basic d3Jvbmc6d3Jvbmc=", "Digest x"]
)
def test_without_a_key_nothing_opens(
    stranger: httpx.Client,
    secrets_: dict[Scope, str],
    method: str,
    path: str,
    authorization: str | None,
) -> None:
    headers = {} if authorization is None else {"Authorization": authorization}
    response = stranger.request(method, path, headers=headers)
    assert (response.status_code, response.json()["code"]) == (401, "unauthorized")
    assert "Bearer" in response.headers["www-authenticate"]


def test_probes_and_styles_need_none(stranger: httpx.Client) -> None:
    for path in ("/livez", "/readyz", "/static/app.css"):
        assert stranger.get(path).status_code == 200, path


def test_no_route_of_the_application_is_open_by_mistake(
    closed: FastAPI, stranger: httpx.Client
) -> None:
    document = closed.openapi()
    for path, methods in document["paths"].items():
        for method in methods:
            expected = path in ("/livez", "/readyz")
            assert (needed_scope(method.upper(), path) is None) is expected, (method, path)


def test_browsers_show_a_key_as_password(
    stranger: httpx.Client, secrets_: dict[Scope, str]
) -> None:
    assert stranger.get("/", auth=("anyone", secrets_[Scope.read])).status_code == 200
    assert stranger.get("/", auth=(secrets_[Scope.read], "anyone")).status_code == 401


def test_a_revoked_key_opens_nothing_within_two_seconds(
    closed: FastAPI, stranger: httpx.Client
) -> None:
    database = closed.state.context.database
    with database.write() as connection:
        key, secret = create_key(connection, "leaver", [Scope.read], time.time())
    headers = {"Authorization": f"Bearer {secret}"}
    wait_until(lambda: stranger.get("/v1/jobs", headers=headers).status_code == 200)
    with database.write() as connection:
        revoke_key(connection, key, time.time())
    wait_until(lambda: stranger.get("/v1/jobs", headers=headers).status_code == 401, seconds=2)


def test_secrets_are_not_in_the_database(closed: FastAPI, secrets_: dict[Scope, str]) -> None:
    settings = closed.state.context.settings
    content = b"".join(path.read_bytes() for path in settings.data.glob("coordinator.sqlite3*"))
    assert b"local-worker" in content  # it is the right file
    assert not any(
        secret.encode() in content for secret in [*secrets_.values(), closed.state.worker_key]
    )


def test_on_loopback_a_key_for_something_else_does_not_make_a_worker(
    app: FastAPI, client: httpx.Client
) -> None:
    with app.state.context.database.write() as connection:
        secret = create_key(connection, "reader", [Scope.read], time.time())[1]
    headers = {"Authorization": f"Bearer {secret}"}
    for path in WORKER_PATHS:
        wait_until(lambda path=path: client.post(path, headers=headers).status_code == 403)  # type: ignore[misc]
        assert client.post(path, headers=headers).json()["code"] == "scope_missing"
    assert client.get("/v1/jobs", headers={"Authorization": "Bearer wrong"}).status_code == 401


def test_a_revoked_worker_key_is_replaced_at_the_next_start(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, durable=False)
    app = make_app(settings)
    old = app.state.worker_key
    with serving(app), app.state.context.database.write() as connection:
        (key,) = list_keys(connection)
        revoke_key(connection, key.id, time.time())
    with serving(app) as url:
        new = settings.worker_key_path.read_text().strip()
        assert new != old
        answer = httpx.post(
            f"{url}/v1/worker/heartbeat", json={}, headers={"Authorization": f"Bearer {new}"}
        )
        assert answer.status_code == 422


def test_keys_are_made_and_revoked_from_the_command_line(tmp_path: Path) -> None:
    def run(*words: str) -> str:
        result = CliRunner().invoke(cli, ["keys", *words, "--data", str(tmp_path / "data")])
        assert result.exit_code == 0, result.output
        return result.stdout

    secret = run("create", "a laptop", "--scope", "read", "--scope", "submit").strip()
    assert len(secret) > 40
    listed = run("list")
    assert "a laptop" in listed
    assert "read, submit" in listed
    assert secret not in listed
    key = listed.splitlines()[1].split()[0]
    run("revoke", key)
    wrong = CliRunner().invoke(cli, ["keys", "revoke", "key-0", "--data", str(tmp_path / "data")])
    assert (wrong.exit_code, "there is no key 'key-0'" in wrong.stderr) == (1, True)


# --- off loopback
# ------------------------------------------------------------------------------------------


def test_off_loopback_only_with_tls_or_a_proxy(tmp_path: Path) -> None:
    with pytest.raises(
        ValidationError, match=r"host must be a loopback address unless .* it is '0\.0\.0\.0'"
    ):
        Settings(data=tmp_path, host="0.0.0.0")
    with pytest.raises(ValidationError, match="must be given together"):
        Settings(data=tmp_path, host="0.0.0.0", tls_certificate=tmp_path)
    with pytest.raises(ValidationError, match="tls_certificate must be a file"):
        Settings(
            data=tmp_path, host="0.0.0.0", tls_certificate=tmp_path / "c", tls_key=tmp_path / "k"
        )
    assert Settings(data=tmp_path, host="0.0.0.0", behind_proxy=True).keys_required
    assert Settings(data=tmp_path, behind_proxy=True).keys_required
    assert not Settings(data=tmp_path).keys_required


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    place = tmp_path_factory.mktemp("tls")
    files = place / "certificate.pem", place / "key.pem"
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
    ]
    command += ["-subj", "/CN=farm.example", "-out", str(files[0]), "-keyout", str(files[1])]
    subprocess.run(command, check=True, capture_output=True)
    return files


@pytest.mark.real
def test_a_coordinator_speaks_tls_and_wants_keys(
    tmp_path: Path, certificate: tuple[Path, Path]
) -> None:
    files = [str(path) for path in certificate]
    server = start_server(
        tmp_path / "data",
        options=["--host", "0.0.0.0", "--tls-certificate", files[0], "--tls-key", files[1]],
    )
    try:
        assert server.url.startswith("https://127.0.0.1:")
        context = ssl.create_default_context(cafile=files[0])
        context.check_hostname = False
        with httpx.Client(base_url=server.url, verify=context, trust_env=False) as client:
            assert client.get("/v1/jobs").status_code == 401
            key = (server.data / "worker-key").read_text().strip()
            answer = client.post(
                "/v1/worker/lease", headers={"Authorization": f"Bearer {key}"}, json={}
            )
            assert answer.status_code == 422
        with pytest.raises(httpx.RemoteProtocolError):  # no plain HTTP on the same port
            httpx.get(server.url.replace("https", "http") + "/livez", trust_env=False)
    finally:
        server.stop()


def test_a_coordinator_off_loopback_without_either_does_not_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--data", str(tmp_path), "--host", "0.0.0.0"]) == 2
    assert "must be a loopback address unless" in capsys.readouterr().err
