"""Hostile requests: each is refused within limits of time and memory, and nothing fails."""

import json
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import httpx
import pytest
from pydantic import TypeAdapter
from stickslip_schemas.documents.worker_api import ReportBatch
from stickslip_services.api.bodies import CERTIFICATE_BYTES, LARGE_BYTES, SPEC_BYTES, JsonBody
from stickslip_services.api.problems import ProblemError
from stickslip_services.app import make_app
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving

SECONDS = 2.0
"""CPU time to refuse a hostile request [s], with the test's own client."""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    app = make_app(Settings(data=tmp_path_factory.mktemp("limits"), durable=False))
    with serving(app) as url, httpx.Client(base_url=url, timeout=60, trust_env=False) as client:
        yield client


def gamma(values: str) -> bytes:
    """A spec of rods with these values of an axis."""
    return f'{{"kind": "rod_hang", "axes": {{"phi0": 1, "phi1": 1, "gamma": {values}}}}}'.encode()


LISTS = "[" + ",".join(["[]"] * 300_000) + "]"
WORDS = "[" + ",".join(['""'] * 300_000) + "]"
TWICE = "[" + ",".join(map(str, range(80_000))) + ", 79999]"
KEYS = "{" + ",".join(f'"{number}": 1' for number in range(70_000)) + "}"
MATERIALS = "{" + ",".join(f'"m{number}": {{}}' for number in range(19_000)) + "}"

HOSTILE_SPECS = {
    "lists as values": (gamma(LISTS), "at most 20000 lists and objects"),
    "words as values": (gamma(WORDS), "/axes/gamma/0: "),
    "the last value twice": (gamma(TWICE), "79999.0 is there twice"),
    "many fields": (KEYS.encode(), "/kind: "),
    "many axes": (f'{{"kind": "rod_hang", "axes": {KEYS}}}'.encode(), "this field is required"),
    "many definitions": (
        f'{{"kind": "cloth_drag", "axes": {{}}, "materials": {MATERIALS}}}'.encode(),
        "this field is required",
    ),
    "nested lists": (b"[" * 900_000, "at most 20000 lists and objects"),
    "more than a megabyte": (gamma("[" + "1," * SPEC_BYTES + "1]"), f"at most {SPEC_BYTES} bytes"),
}


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs:validate"])
@pytest.mark.parametrize("name", HOSTILE_SPECS)
def test_a_hostile_spec_is_refused_at_once(client: httpx.Client, path: str, name: str) -> None:
    body, rule = HOSTILE_SPECS[name]
    began_at = time.process_time()
    answer = client.post(path, content=body, headers={"Content-Type": "application/json"})
    assert time.process_time() - began_at < SECONDS
    assert answer.status_code in (413, 422)
    assert rule in answer.json()["detail"]
    assert len(answer.content) < 50_000


def test_a_large_report_is_not_read_in_one_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """pydantic keeps the interpreter for 1 to 2 s where it reads 16 MB; no probe is answered."""

    def hold_the_interpreter(*_arguments: object) -> None:
        pytest.fail("a large body is read by pydantic alone")

    monkeypatch.setattr(TypeAdapter, "validate_json", hold_the_interpreter)
    numbers = "[" + ",".join(["1.5"] * (LARGE_BYTES // 4 + 1)) + "]"
    body = f'{{"worker_id": "w", "reports": [{{"task_id": "t", "labels": {numbers}}}]}}'.encode()
    reader = JsonBody(ReportBatch, max_containers=100, from_workers=True)
    with pytest.raises(ProblemError) as caught:
        reader.read(body)
    assert all(len(field.value) <= 200 for field in caught.value.fields)


def test_a_body_without_a_length_is_cut_off_at_the_limit(client: httpx.Client) -> None:
    sent = 0

    def blocks() -> Iterator[bytes]:
        nonlocal sent
        for _ in range(1000):
            sent += 2**16
            yield b" " * 2**16

    headers = {"Content-Type": "application/json"}
    try:
        answer = client.post("/v1/jobs", content=blocks(), headers=headers)
        assert answer.status_code == 413
    except httpx.WriteError:  # the coordinator closes the connection while the client still sends
        pass
    assert sent < 1000 * 2**16


@pytest.mark.parametrize(
    ("path", "limit"), [("/v1/jobs", SPEC_BYTES), ("/v1/certificates", CERTIFICATE_BYTES)]
)
def test_a_body_that_declares_too_many_bytes_is_not_read(
    client: httpx.Client, path: str, limit: int
) -> None:
    connection = HTTPConnection(client.base_url.host, client.base_url.port, timeout=10)
    connection.putrequest("POST", path)
    connection.putheader("Content-Type", "application/json")
    connection.putheader("Content-Length", str(limit + 1))
    connection.endheaders()  # and no byte of the body
    answer = connection.getresponse()
    assert (answer.status, json.load(answer)["code"]) == (413, "body_too_large")
    connection.close()


@pytest.mark.parametrize(
    ("method", "path", "name", "hint"),
    [
        ("GET", "/v1/jobs?limit=abc", "limit", "Parameters: page_size, page_token, project"),
        ("GET", "/v1/jobs?stat=queued", "stat", "did you mean state?"),
        ("GET", "/v1/datasets?page=2", "page", "did you mean page_size?"),
        ("GET", "/v1/workers?all=1", "all", "Parameters: none"),
        ("GET", "/v1/certificates?preset=fine", "preset", "Parameters: page_size, page_token"),
        ("POST", "/v1/jobs?prority=3", "prority", "did you mean priority?"),
        ("POST", "/v1/jobs:validate?priority=3", "priority", "Parameters: none"),
        ("GET", "/metrics?format=json", "format", "Parameters: none"),
        ("GET", "/v1/jobs?page_size=1&page_size=2", "page_size", "must be given once"),
    ],
)
def test_an_unknown_query_parameter_is_refused(
    client: httpx.Client, method: str, path: str, name: str, hint: str
) -> None:
    answer = client.request(method, path, json=rods() if method == "POST" else None)
    assert answer.status_code == 422, answer.text
    assert answer.json()["errors"][0]["pointer"] == f"/query/{name}"
    assert hint in answer.json()["detail"]


def test_probes_may_add_parameters(client: httpx.Client) -> None:
    """A load balancer adds a time against caches; a health check must not fail for it."""
    assert client.get("/livez?now=1").status_code == 200
    assert client.get("/readyz?now=1").status_code == 200


@pytest.mark.parametrize(
    ("query", "rule"),
    [
        ("page_size=0", "page_size must be at least 1"),
        ("page_size=x", "page_size must be a whole number"),
        ("page_size=1e9", "page_size must be a whole number"),
        ("page_size=100000", "page_size must be at most "),
        ("page_token=x", "page_token must be the `next_page_token` of the page before"),
        ("state=done", "state must be one of planning, queued, running"),
        ("search=" + "x" * 101, "search must have at most 100 characters"),
    ],
)
def test_a_wrong_parameter_names_its_rule_in_words(
    client: httpx.Client, query: str, rule: str
) -> None:
    detail = client.get(f"/v1/jobs?{query}").json()["detail"]
    assert rule in detail
    assert "pattern" not in detail
    assert "Input should" not in detail


def test_a_wrong_event_id_names_its_rule(client: httpx.Client, tmp_path: Path) -> None:
    job = client.post("/v1/jobs", json=rods()).json()["id"]
    answer = client.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "x"})
    assert answer.status_code == 422
    assert "last-event-id must be the id of an event" in answer.json()["detail"]
