"""`pull` from a server that never ends, lies or bombs: a clear error within the stated size.

Each pull runs in a process of its own, whose memory is measured.
"""

import gzip
import http.server
import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from numcodecs.zstd import Zstd
from stickslip_schemas.base import sha256
from stickslip_schemas.format.codecs import encode_chunk
from stickslip_schemas.format.manifest import Manifest, seal_text, with_manifest_digest
from stickslip_schemas.transport.limits import DOCUMENT_BYTES, DOCUMENT_CONTAINERS, DOCUMENT_VALUES
from stickslip_services.app import make_app
from stickslip_services.client import Client, pull
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker

pytestmark = pytest.mark.real

MEGABYTE = 2**20
MEMORY_LIMIT = 200 * MEGABYTE
"""Most memory that a pull may add to that of its imports [bytes]."""

PULL = """
import resource, sys
from stickslip_services.cli import app, datasets
import numpy, stickslip_schemas.format.codecs
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
status = 0
try:
    app(sys.argv[1:])
except SystemExit as end:
    status = end.code
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(status, (after - before) * 1024)
"""

Blocks = Iterator[bytes]
Answer = Callable[[], tuple[dict[str, str], Blocks]]


def plain(data: bytes) -> Answer:
    return lambda: ({"Content-Length": str(len(data))}, iter([data]))


class Server(http.server.ThreadingHTTPServer):
    """Serves answers by the last part of their path below a version."""

    daemon_threads = True
    answers: dict[str, Answer]
    bytes_sent: int

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        name = self.path.partition("/versions/1")[2].removeprefix("/").removeprefix("files/")
        if name not in self.server.answers:
            body = b'{"type":"x","title":"x","status":404,"detail":"x","code":"not_found"}'
            self.send_response(404)
            self.send_header("Content-Type", "application/problem+json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            return
        headers, blocks = self.server.answers[name]()
        self.send_response(200)
        for header, value in {"Content-Type": "application/json", **headers}.items():
            self.send_header(header, value)
        self.end_headers()
        with suppress(OSError):
            for block in blocks:
                self.wfile.write(block)
                self.server.bytes_sent += len(block)
        self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass


def endless(block: bytes) -> Answer:
    """Send a block again and again, up to a gigabyte."""

    def blocks() -> Blocks:
        for _ in range(2**30 // len(block)):
            yield block

    return lambda: ({}, blocks())


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], Manifest]:
    """The answers of a real coordinator for a version, by path, and its manifest."""
    app = make_app(Settings(data=tmp_path_factory.mktemp("origin"), durable=False))
    target = tmp_path_factory.mktemp("pulled") / "d"
    with serving(app) as url, Client(url) as client:
        context = app.state.context
        worker = PretendWorker(DirectApi(context), context.store, whole=True).register()
        job = client.submit(rods(gamma=(1.0, 2.0)))
        worker.work()
        reference = client.job(job.id).dataset
        assert reference is not None
        pull(client, reference.dataset, 1, target)
        base = f"/v1/datasets/{reference.dataset}/versions/1"
        answers = {"": client.request("GET", base).content}
    for path in target.rglob("*"):
        if path.is_file():
            answers[path.relative_to(target).as_posix()] = path.read_bytes()
    answers["manifest"] = answers["manifest.json"]
    return answers, Manifest.model_validate_json(answers["manifest"])


@pytest.fixture
def server(honest: tuple[dict[str, bytes], Manifest]) -> Iterator[Server]:
    server = Server(("127.0.0.1", 0), Handler)
    server.answers = {path: plain(data) for path, data in honest[0].items()}
    server.bytes_sent = 0
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def reseal(server: Server, honest: dict[str, bytes], manifest: bytes) -> None:
    """Let a server serve another manifest with a seal that fits it."""
    group = with_manifest_digest(honest["zarr.json"], sha256(manifest))
    record = json.loads(honest[""]) | {"manifest": sha256(manifest), "group": sha256(group)}
    seal = seal_text(sha256(manifest), sha256(group))
    server.answers |= {
        "": plain(json.dumps(record).encode()),
        "manifest": plain(manifest),
        "zarr.json": plain(group),
        "manifest.sha256": plain(seal),
    }


def run_pull(server: Server, dataset: str, target: Path, *options: str) -> tuple[int, str, int]:
    """Return the exit status, the error output, and the memory that a pull added [bytes]."""
    words = ["pull", f"{dataset}:v1", str(target), "--url", server.url, *options]
    done = subprocess.run(
        [sys.executable, "-c", PULL, *words], capture_output=True, text=True, check=True, timeout=60
    )
    status, memory = done.stdout.splitlines()[-1].split()
    assert "Traceback" not in done.stderr
    return int(status), done.stderr, int(memory)


def size_below(target: Path) -> int:
    return sum(path.stat().st_size for path in target.rglob("*") if path.is_file())


def test_an_honest_server_is_pulled_from(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path
) -> None:
    status, error, memory = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert status == 0, error
    assert memory < MEMORY_LIMIT


def test_a_file_that_never_ends(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path
) -> None:
    manifest = honest[1]
    file = next(file for file in manifest.files if file.path.startswith("views/c"))
    server.answers[file.path] = endless(bytes(2**16))
    status, error, memory = run_pull(server, manifest.dataset, tmp_path / "d")
    assert status == 1
    message = f"more than the {file.size} bytes that the manifest states"
    assert message in " ".join(error.split())
    assert memory < MEMORY_LIMIT
    assert size_below(tmp_path) <= sum(entry.size for entry in manifest.files)
    assert server.bytes_sent < 64 * MEGABYTE


@pytest.mark.parametrize("name", ["", "manifest", "zarr.json", "manifest.sha256"])
def test_a_document_that_never_ends(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path, name: str
) -> None:
    server.answers[name] = endless(b" " * 2**16)
    status, error, memory = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert status == 1
    assert "bytes that are accepted" in error
    assert memory < MEMORY_LIMIT
    assert server.bytes_sent < 64 * MEGABYTE


@pytest.mark.parametrize("name", ["", "manifest", "views/c/0/0/0/0/0"])
def test_a_bomb_of_gzip(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path, name: str
) -> None:
    bomb = gzip.compress(bytes(2**28))
    assert name in server.answers
    server.answers[name] = lambda: (
        {"Content-Encoding": "gzip", "Content-Length": str(len(bomb))},
        iter([bomb]),
    )
    status, error, memory = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert status == 1
    assert "compressed" in error
    assert memory < MEMORY_LIMIT


def test_a_manifest_of_many_files(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path
) -> None:
    """As many as fit into the largest document, none of which the server has."""
    document = json.loads(honest[0]["manifest"])
    document["files"] = []
    text = json.dumps(document, separators=(",", ":"))
    entry = '{"path":"%06x","sha256":"%064x","size":0}'
    count = (DOCUMENT_BYTES - len(text)) // (len(entry % (0, 0)) + 1) - 1
    entries = ",".join(entry % (number, number) for number in range(count))
    manifest = text.replace('"files":[]', f'"files":[{entries}]').encode()
    reseal(server, honest[0], manifest)
    status, _, memory = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert status == 1
    assert memory < MEMORY_LIMIT


def long_list(item: str, field: str, document: dict[str, object]) -> bytes:
    """Return a manifest with a list of as many items in a field as the largest document takes."""
    text = json.dumps(document, separators=(",", ":"))
    count = (DOCUMENT_BYTES - len(text)) // (len(item) + 1) - 1
    return text.replace(f'"{field}":[]', f'"{field}":[{",".join([item] * count)}]').encode()


@pytest.mark.parametrize(
    ("field", "item"),
    [("files", "[]"), ("files", "0.5"), ("sample_keys", '""'), ("gamma", "[]"), ("gamma", "0.5")],
)
def test_a_manifest_of_wrong_values(
    server: Server,
    honest: tuple[dict[str, bytes], Manifest],
    tmp_path: Path,
    field: str,
    item: str,
) -> None:
    """Neither the values nor the errors that they cause fill the memory."""
    document = json.loads(honest[0]["manifest"])
    if field == "gamma":
        document["spec"]["axes"]["gamma"] = []
    else:
        document[field] = []
    manifest = long_list(item, field, document)
    assert len(manifest) > 0.9 * DOCUMENT_BYTES
    reseal(server, honest[0], manifest)
    status, error, memory = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert (status, "must have at most" in " ".join(error.split())) == (1, True), error
    assert memory < MEMORY_LIMIT


@pytest.mark.parametrize("item", ["{}", "0.5"])
def test_as_many_wrong_values_as_are_parsed(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path, item: str
) -> None:
    document = json.loads(honest[0]["manifest"])
    document["files"] = []
    count = DOCUMENT_CONTAINERS - 1000 if item == "{}" else DOCUMENT_VALUES - 1000
    text = json.dumps(document, separators=(",", ":"))
    manifest = text.replace('"files":[]', f'"files":[{",".join([item] * count)}]').encode()
    reseal(server, honest[0], manifest)
    status, error, memory = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert (status, "sent an unexpected answer: files.0" in " ".join(error.split())) == (1, True)
    assert memory < MEMORY_LIMIT


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sample_count": 10**12}, "states 1000000000000 samples"),
        ({"sample_keys": []}, "lists 0"),
    ],
)
def test_a_manifest_that_lies_about_its_samples(
    server: Server,
    honest: tuple[dict[str, bytes], Manifest],
    tmp_path: Path,
    change: dict[str, object],
    message: str,
) -> None:
    document = json.loads(honest[0]["manifest"]) | change
    reseal(server, honest[0], json.dumps(document).encode())
    status, error, memory = run_pull(
        server, honest[1].dataset, tmp_path / "d", "--where", "gamma<1.5"
    )
    assert (status, message in " ".join(error.split())) == (1, True), error
    assert memory < MEMORY_LIMIT
    assert not (tmp_path / "d").exists()


def test_a_manifest_of_files_larger_than_the_disk(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path
) -> None:
    document = json.loads(honest[0]["manifest"])
    document["files"][0]["size"] = 10**17
    reseal(server, honest[0], json.dumps(document).encode())
    status, error, _ = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert (status, "bytes free, and the files have" in " ".join(error.split())) == (1, True)


def test_a_file_of_a_hidden_folder(
    server: Server, honest: tuple[dict[str, bytes], Manifest], tmp_path: Path
) -> None:
    document = json.loads(honest[0]["manifest"])
    hook = b"#!/bin/sh\n"
    path = "x/.git/hooks/post-checkout"
    document["files"].append({"path": path, "sha256": sha256(hook), "size": len(hook)})
    reseal(server, honest[0], json.dumps(document).encode())
    server.answers[path] = plain(hook)
    status, error, _ = run_pull(server, honest[1].dataset, tmp_path / "d")
    assert (status, "is hidden; nothing was written" in " ".join(error.split())) == (1, True)
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(
    ("size", "states_its_size", "message"),
    [
        (2**31, True, "is larger than 32 bytes can be"),
        (2**24, True, "decodes to 16777216 bytes, and 32 are expected"),
        (2**24, False, "decodes to an unstated number of bytes, and 32 are expected"),
    ],
)
def test_a_label_that_decodes_to_gigabytes(
    server: Server,
    honest: tuple[dict[str, bytes], Manifest],
    tmp_path: Path,
    size: int,
    states_its_size: bool,
    message: str,
) -> None:
    """A small chunk whose zstd frame decodes to 2 GB, or to 16 MB from under a kilobyte."""
    chunk = encode_chunk(bytes(size)) if states_its_size else streamed_chunk(size)
    assert len(chunk) < 2**17
    document = json.loads(honest[0]["manifest"])
    for entry in document["files"]:
        if entry["path"] == "gamma/c/0":
            entry |= {"sha256": sha256(chunk), "size": len(chunk)}
    reseal(server, honest[0], json.dumps(document).encode())
    server.answers["gamma/c/0"] = plain(chunk)
    status, error, memory = run_pull(
        server, honest[1].dataset, tmp_path / "d", "--where", "gamma<1.5"
    )
    assert (status, message in " ".join(error.split())) == (1, True), error
    assert memory < MEMORY_LIMIT


def streamed_chunk(size: int) -> bytes:
    """Return a chunk whose frame does not state the size of its content, as streams do."""
    from stickslip_schemas.format.codecs import _with_crc

    frame = bytearray(bytes(Zstd(level=3).encode(bytes(size))))
    # The descriptor without a content size needs a window descriptor [RFC 8878, 3.1.1.1].
    descriptor = frame[4]
    width = (1, 2, 4, 8)[descriptor >> 6]
    has_window = not descriptor >> 5 & 1
    header = bytes([descriptor & 0b00000111]) + (bytes(frame[5:6]) if has_window else b"\xa8")
    rest = bytes(frame[5 + has_window + width :])
    return _with_crc(bytes(frame[:4]) + header + rest)
