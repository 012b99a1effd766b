"""Uploads: hostile files are refused with 4xx, and decoded where they can do no harm."""

import io
import json
import os
import re
import struct
import subprocess
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from PIL import Image
from sqlalchemy import insert
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.library import load_scene
from stickslip_services.app import make_app
from stickslip_services.catalog import inspection
from stickslip_services.catalog.inspector import INSPECTOR, Inspector
from stickslip_services.database.tables import uploads
from stickslip_services.settings import Settings
from stickslip_testing.servers import serving

BINARY = {"Content-Type": "application/octet-stream"}
TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return make_app(Settings(data=tmp_path_factory.mktemp("uploads"), durable=False))


@pytest.fixture(scope="module")
def client(app: FastAPI) -> Iterator[httpx.Client]:
    with serving(app) as url, httpx.Client(base_url=url, timeout=60, trust_env=False) as client:
        yield client


def npz(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def archive(header: str, *, name: str = "positions.npy") -> bytes:
    """An NPZ file of one array with any header."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as members:
        text = header.encode()
        content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(24)
        members.writestr(name, content)
    return file.getvalue()


def shaped(shape: str, number: str = "<f8") -> bytes:
    return archive(f"{{'descr': '{number}', 'fortran_order': False, 'shape': {shape}, }}")


HOSTILE = {
    "80 GB": shaped("(10000000000,)"),
    "10^30": shaped("(1" + "0" * 30 + ",)"),
    "deep header": archive("(" * 900),
    "no array": archive("", name="read.me"),
    "bool side": shaped("(True, 3)"),
    "negative side": shaped("(-1, 3)"),
    "booleans": shaped("(1, 3)", "|b1"),
    "200 MB of zeros": npz(positions=np.zeros(25_000_000)),
    "no archive": b"PK\x03\x04 and no more",
    "two million faces": TRIANGLE + b"f 1 2 3\n" * 2_000_000,
    "a face of 8 million corners": TRIANGLE + b"f" + b" 1" * 7_000_000,
    "rows": b"time,x,y,z,rx,ry,rz\n" + b"0,0,0,0,0,0,0\n" * 1_100_000,
    "bytes": bytes(range(256)) * 100,
    "nothing": b"",
    "lines": b"\n" * (16 * 2**20),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused(client: httpx.Client, name: str) -> None:
    began_at = time.process_time()
    answer = client.post("/v1/files", content=HOSTILE[name], headers=BINARY)
    assert time.process_time() - began_at < 2.0  # of the coordinator and of this client
    assert (answer.status_code, answer.json()["code"]) == (422, "validation_failed"), answer.text
    assert "must" in answer.json()["errors"][0]["rule"]


@pytest.mark.parametrize("name", [name for name in HOSTILE if name not in ("nothing", "lines")])
@pytest.mark.parametrize("path", ["/v1/jobs:validate", "/v1/jobs"])
def test_a_spec_of_a_hostile_file_is_refused(
    app: FastAPI, client: httpx.Client, name: str, path: str
) -> None:
    """Also where an earlier build has accepted the file."""
    context = app.state.context
    digest = context.store.publish(HOSTILE[name])
    scene = load_scene("wipe").model_dump(mode="json")
    first = next(iter(scene["sheets"].values()))
    first["start"] = {"type": "file", "file": f"sha256:{digest}"}
    with context.database.write() as connection:
        connection.execute(uploads.delete())
        connection.execute(insert(uploads).values(project="", digest=digest))
    axes = {"texture": "dots", "viewpoint": "front"}
    answer = client.post(path, json={"kind": "cloth_scene", "scene": scene, "axes": axes})
    assert answer.status_code == 422, answer.text
    detail = answer.json()["detail"]
    assert re.search(r"/start/file: must name a file that fits: .*must", detail), detail


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        (b"\x89PNG\r\n\x1a\n", "whole PNG or JPEG"),
        (b"\x89PNG\r\n\x1a\n" + bytes(1000), "whole PNG or JPEG"),
    ],
)
def test_a_broken_picture_is_refused_in_words(client: httpx.Client, data: bytes, rule: str) -> None:
    answer = client.post("/v1/textures", content=data, headers={"Content-Type": "image/png"})
    assert answer.status_code == 422
    assert rule in answer.json()["detail"]
    assert "object at 0x" not in answer.text


def test_fit_files_are_accepted(client: httpx.Client) -> None:
    mesh = client.post("/v1/files", content=TRIANGLE, headers=BINARY).json()
    assert mesh["counts"] == [3, 1]
    start = client.post("/v1/files", content=npz(positions=np.zeros((9, 3))), headers=BINARY)
    assert start.status_code == 201, start.text


def picture(side: int, shade: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (side, side), (shade, 0, 0)).save(file, format="PNG")
    return file.getvalue()


def memory(pid: int) -> int:
    """Return the memory of a process [bytes]."""
    fields = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")


def test_pictures_are_decoded_elsewhere_and_their_memory_comes_back(client: httpx.Client) -> None:
    """Four pictures of 4,096 x 4,096 pixels at once took 1 GB, and /livez seconds."""
    client.post("/v1/textures", content=picture(64, 1), headers={"Content-Type": "image/png"})
    before = memory(os.getpid())
    pictures = [picture(4096, shade) for shade in range(4)]
    statuses: list[int] = []

    def upload(data: bytes) -> None:
        headers = {"Content-Type": "image/png"}
        answer = httpx.post(
            client.base_url.join("/v1/textures"),
            content=data,
            headers=headers,
            timeout=120,
            trust_env=False,
        )
        statuses.append(answer.status_code)

    threads = [threading.Thread(target=upload, args=(data,)) for data in pictures]
    for thread in threads:
        thread.start()
    slowest = 0.0
    while any(thread.is_alive() for thread in threads):
        began_at = time.monotonic()
        assert client.get("/livez").status_code == 200
        slowest = max(slowest, time.monotonic() - began_at)
        time.sleep(0.02)
    assert statuses == [201] * 4
    assert slowest < 1.0
    assert memory(os.getpid()) - before < 100 * 2**20


def ask(inspector: Inspector, data: bytes, name: str = "scene_file") -> object:
    return inspector.inspect_bytes(data, {"inspection": name})


def test_a_process_that_dies_is_a_refusal_and_the_next_file_is_read() -> None:
    """A texture that takes more memory than the limit leaves: the smallest limit is 0 B."""
    inspector = Inspector()
    try:
        assert ask(inspector, TRIANGLE) == [3, 1]
        assert inspector._program is not None
        inspector._program.kill()
        inspector._program.wait()
        assert ask(inspector, TRIANGLE) == [3, 1]
    finally:
        inspector.close()


def test_an_unknown_failure_is_a_refusal_and_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(UnfitFileError, match="the coordinator's log says more"):
        ask(INSPECTOR, TRIANGLE, "no such inspection")
    assert "KeyError" in caplog.text


def test_the_program_has_no_secret_of_the_coordinator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STICKSLIP_DATABASE", "postgresql://user:password@host/name")
    inspector = Inspector()
    try:
        ask(inspector, TRIANGLE)
        assert inspector._program is not None
        environment = Path(f"/proc/{inspector._program.pid}/environ").read_bytes()
        assert b"password" not in environment
    finally:
        inspector.close()


LIMITED = """
import os, sys, json
from stickslip_services.catalog import inspection
inspection.{limit}
inspection._INSPECTIONS["greedy"] = lambda data, question: {greed}
import socket
inspection.serve(socket.socket(fileno=int(sys.argv[1])))
"""


@pytest.mark.parametrize(
    ("limit", "greed", "answer"),
    [
        ("CPU_SECONDS = 1", "[0 for _ in iter(int, 1)]", None),
        ("MEMORY_BYTES = 50 * 2**20", "len(bytes(200 * 2**20))", "at most 50 MiB to be read"),
        ("CPU_SECONDS = 1", "os.kill(os.getpid(), 9)", None),
    ],
    ids=["time", "memory", "killed"],
)
def test_a_process_has_limits(limit: str, greed: str, answer: str | None) -> None:
    import socket
    import sys

    requests, far_end = socket.socketpair()
    with requests, far_end:
        program = subprocess.Popen(
            [sys.executable, "-c", LIMITED.format(limit=limit, greed=greed), str(far_end.fileno())],
            pass_fds=[far_end.fileno()],
        )
        inspector = Inspector()
        inspector._program = program
        inspector._requests = requests
        rule = "within 10 s of CPU time" if answer is None else answer
        with pytest.raises(UnfitFileError, match=rule):
            ask(inspector, TRIANGLE, "greedy")
        requests.close()
        far_end.close()
        program.wait(timeout=10)


def test_the_answer_of_a_program_is_json() -> None:
    """NaN and Infinity are none."""
    assert json.loads(json.dumps(inspection._answer({"inspection": "scene_file"}, TRIANGLE))) == {
        "result": [3, 1]
    }
