"""Clients that take their time: half-open headers and bodies are closed, and the API serves
meanwhile.
"""

import json
import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
from stickslip_services.api import protocol
from stickslip_services.app import make_app
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import ServerProcess, serving, start_server

HEADERS = b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
HALF_HEADERS = HEADERS[:30]
HALF_BODY = HEADERS + b"Content-Length: 1000\r\n\r\n{"
HALF_REFUSED = b"POST /v1/worker/lease HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n\r\n{"


def connect(url: str, opening: bytes) -> socket.socket:
    host, port = url.removeprefix("http://").split(":")
    connection = socket.create_connection((host, int(port)), timeout=30)
    connection.sendall(opening)
    return connection


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ServerProcess]:
    """A server that does not share the file descriptors of the test."""
    running = start_server(tmp_path / "data")
    yield running
    running.stop()


@pytest.mark.real
def test_600_half_open_requests_are_closed_within_20_seconds(server: ServerProcess) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    begin = time.monotonic()
    openings = [HALF_BODY, HALF_HEADERS, b"", HALF_BODY]
    attackers = [connect(server.url, openings[number % 4]) for number in range(600)]
    longest = 0.0
    with httpx.Client(base_url=server.url, trust_env=False, timeout=10) as client:
        for _ in range(20):
            asked = time.monotonic()
            assert client.get("/v1/jobs").status_code == 200
            longest = max(longest, time.monotonic() - asked)
    for attacker in attackers:
        attacker.settimeout(max(0.1, begin + 20 - time.monotonic()))
        while attacker.recv(4096):
            pass  # the answer, and then the end
        attacker.close()
    assert time.monotonic() - begin < 20
    assert longest < 5


@pytest.fixture
def quick(tmp_path: object, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A server that gives a client half a second."""
    monkeypatch.setattr(protocol, "TURN_SECONDS", 0.5)
    with serving(make_app(settings)) as url:
        yield url


def answer(connection: socket.socket) -> bytes:
    received = b""
    while data := connection.recv(65536):
        received += data
    return received


@pytest.mark.parametrize("opening", [HALF_BODY, HALF_HEADERS, b""])
def test_who_is_too_slow_is_told(quick: str, opening: bytes) -> None:
    begin = time.monotonic()
    with connect(quick, opening) as connection:
        head, _, body = answer(connection).partition(b"\r\n\r\n")
    assert 0.4 < time.monotonic() - begin < 5
    assert head.startswith(b"HTTP/1.1 408 ")
    assert b"application/problem+json" in head
    assert json.loads(body)["code"] == "too_slow"


@pytest.mark.parametrize("opening", [HALF_BODY, HALF_HEADERS, HALF_REFUSED])
def test_drop_by_drop_is_too_slow_as_well(quick: str, opening: bytes) -> None:
    """Also after a refusal, for which the coordinator did not wait for the body."""
    with connect(quick, opening) as connection:
        begin = time.monotonic()
        with suppress(OSError):  # reset or broken pipe
            while time.monotonic() < begin + 10:
                connection.sendall(b"x")
                time.sleep(0.1)
        assert time.monotonic() - begin < 5


def test_a_steady_body_may_take_its_time(quick: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "MIN_RATE", 100)
    body = json.dumps(rods()).encode()
    with connect(
        quick, HEADERS + f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode()
    ) as connection:
        begin = time.monotonic()
        for start in range(0, len(body), 25):
            connection.sendall(body[start : start + 25])
            time.sleep(0.15)
        assert time.monotonic() - begin > 0.6
        assert answer(connection).startswith(b"HTTP/1.1 202 ")


def test_an_answer_may_take_as_long_as_it_takes(quick: str) -> None:
    job = httpx.post(f"{quick}/v1/jobs", json=rods(), trust_env=False).json()["id"]
    with httpx.stream(
        "GET", f"{quick}/v1/jobs/{job}/events", trust_env=False, timeout=10
    ) as stream:
        lines = stream.iter_lines()
        begin = time.monotonic()
        threading.Timer(1.5, httpx.post, (f"{quick}/v1/jobs/{job}:cancel",)).start()
        assert any('"cancelled"' in line for line in lines)
        assert time.monotonic() - begin > 1.0


def test_a_kept_connection_serves_request_after_request(quick: str) -> None:
    with httpx.Client(base_url=quick, trust_env=False) as client:
        for _ in range(4):
            assert client.get("/v1/jobs").status_code == 200
            time.sleep(0.3)


def test_too_many_connections_are_refused(quick: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "MAX_CONNECTIONS", 3)
    monkeypatch.setattr(protocol, "TURN_SECONDS", 5.0)
    held = [connect(quick, HALF_BODY) for _ in range(3)]
    time.sleep(0.2)
    with connect(quick, b"") as connection:
        assert answer(connection).startswith(b"HTTP/1.1 503 ")
    for connection in held:
        connection.close()
    time.sleep(0.2)
    assert httpx.get(f"{quick}/v1/jobs", trust_env=False).status_code == 200


def test_idle_connections_are_kept_longer_than_clients_keep_them(
    quick: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With equal times, a request sometimes meets a connection that is being closed, and fails."""
    assert protocol.IDLE_SECONDS >= 2 * (httpx.Limits().keepalive_expiry or 0.0) > 0.0
    monkeypatch.setattr(protocol, "IDLE_SECONDS", 0.3)
    begin = time.monotonic()
    with connect(quick, b"GET /readyz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") as connection:
        assert answer(connection).startswith(b"HTTP/1.1 200")  # and then the end
    assert time.monotonic() - begin < 4  # uvicorn's own limit is 5 s
