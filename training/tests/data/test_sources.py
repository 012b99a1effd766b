"""Reading over HTTP, from a real server on a local port."""

import contextlib
import gzip
import http.server
import multiprocessing
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import Samples
from stickslip_training.data.sources import CorruptDataError, MissingFileError, SourceError


class _Server(http.server.ThreadingHTTPServer):
    root: Path
    requests: list[tuple[str, str | None]]
    ranges = True
    failures = 0  # so many requests are answered 503 first
    key: str | None = None
    cut = 0  # so many bytes less in every body of a range
    redirect = ""  # a server that every request is sent to
    fault = ""  # the answers are hostile
    bytes_sent = 0
    keys_sent: list[str | None]

    def handle_error(self, *_):
        """Say nothing about a client that has gone away."""


class _Handler(http.server.BaseHTTPRequestHandler):
    """Serve the files of a dataset version as the service does, with ranges."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # header and body are two writes
    server: _Server

    def do_GET(self):
        self.server.requests.append((self.path, self.headers["Range"]))
        self.server.keys_sent.append(self.headers["Authorization"])
        if self.server.redirect:
            return self._answer(302, headers={"Location": self.server.redirect + self.path})
        if self.server.fault:
            return self._send_hostile()
        if self.server.failures:
            self.server.failures -= 1
            return self._answer(503)
        if self.server.key and self.headers["Authorization"] != f"Bearer {self.server.key}":
            return self._answer(401)
        prefix = "/v1/datasets/ds-x/versions/1/"
        if self.path.startswith(prefix + "files/"):
            path = self.server.root / self.path.removeprefix(prefix + "files/")
        else:
            path = self.server.root / self.path.removeprefix("/static/")
        if not path.is_file():
            return self._answer(404)
        data = path.read_bytes()
        asked = re.match(r"bytes=(\d+)-(\d+)$", self.headers["Range"] or "")
        if not asked or not self.server.ranges:
            return self._answer(200, data)
        first, last = int(asked[1]), min(int(asked[2]), len(data) - 1)
        if first >= len(data):
            return self._answer(416)
        body = data[first : last + 1][: last + 1 - first - self.server.cut]
        return self._answer(206, body, {"Content-Range": f"bytes {first}-{last}/{len(data)}"})

    def _answer(self, status, body=b"", headers=None):
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | (headers or {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _send_hostile(self):
        """Send a body without an end, a compressed one, or one that states a huge size."""
        self.send_response(200)
        if self.server.fault == "gzip":
            self.send_header("Content-Encoding", "gzip")
        if self.server.fault == "too long":
            self.send_header("Content-Length", str(10**12))
        self.send_header("Connection", "close")
        self.end_headers()
        block = gzip.compress(bytes(2**24)) if self.server.fault == "gzip" else b" " * 2**16
        with contextlib.suppress(OSError):
            while self.server.bytes_sent < 2**30:
                self.wfile.write(block)
                self.server.bytes_sent += len(block)
        self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def server(seen_rods) -> Iterator[_Server]:
    server = _Server(("127.0.0.1", 0), _Handler)
    server.root = seen_rods.root
    server.requests = []
    server.keys_sent = []
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def _url(server: _Server, tail: str = "v1/datasets/ds-x/versions/1") -> str:
    return f"http://127.0.0.1:{server.server_address[1]}/{tail}"


@pytest.mark.parametrize(
    "tail",
    [
        "v1/datasets/ds-x/versions/1",
        "v1/datasets/ds-x/versions/1/",
        "v1/datasets/ds-x/versions/1/files/",
        "v1/datasets/ds-x/versions/1/manifest",
        "static",
    ],
)
def test_every_form_of_the_url_opens_the_dataset(server, seen_rods, tail):
    with DatasetReader(_url(server, tail)) as reader:
        for name in reader.arrays:
            values = reader.read(name, reader.slots())
            assert values.tobytes() == seen_rods.arrays[name][reader.slots()].tobytes()


def test_one_request_a_sample(server, seen_rods):
    with DatasetReader(_url(server)) as reader:
        reader.read("views", [0])
        server.requests.clear()
        views = reader.read("views", [3, 1, 0])
        assert np.array_equal(views, seen_rods.arrays["views"][[3, 1, 0]])
        assert len(server.requests) == 3
        assert all(wanted is not None for _, wanted in server.requests)


def test_verify_reads_every_file(server, seen_rods):
    with DatasetReader(_url(server), verify=True):
        paths = {path.split("/files/")[1] for path, _ in server.requests if "/files/" in path}
        listed = {file.path for file in seen_rods.manifest.files}
        assert paths == listed | {"manifest.json", "zarr.json", "manifest.sha256"}


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.real
def test_workers_make_connections_of_their_own(server, seen_rods, method):
    dataset = Samples(_url(server), arrays=["centerline", "views"])
    dataset[0]  # the parent is connected already
    loader = dataset.loader(
        2, num_workers=2, multiprocessing_context=multiprocessing.get_context(method)
    )
    for batch in loader:
        assert np.array_equal(
            batch["views"].numpy(), seen_rods.arrays["views"][batch["slot"].numpy()]
        )
    assert np.array_equal(dataset[0]["views"].numpy(), seen_rods.arrays["views"][0])
    dataset.close()


def test_a_busy_server_is_asked_again(server):
    server.failures = 2
    with DatasetReader(_url(server)) as reader:
        assert len(reader) == 6


def test_a_server_that_stays_away_is_an_error(server, monkeypatch):
    monkeypatch.setattr("stickslip_training.data.sources.READER_RETRY_SECONDS", 0.5)
    server.failures = 100
    with pytest.raises(SourceError, match=r"manifest.json answered 503, and 200 was expected"):
        DatasetReader(_url(server))
    with pytest.raises(SourceError, match=r"does not answer: .*refused"):
        DatasetReader("http://127.0.0.1:9/v1/datasets/ds-x/versions/1")


def test_a_version_that_is_not_there(server):
    with pytest.raises(
        MissingFileError, match=r"manifest.json is not there: this is no committed dataset version"
    ):
        DatasetReader(_url(server, "v1/datasets/ds-x/versions/2"))


def test_the_key_is_sent(server, monkeypatch):
    server.key = "secret"
    with pytest.raises(SourceError, match="answered 401"):
        DatasetReader(_url(server), api_key="wrong")
    monkeypatch.setenv("STICKSLIP_API_KEY", "secret")
    monkeypatch.setenv("STICKSLIP_URL", _url(server, ""))
    with DatasetReader(_url(server)) as reader:
        assert len(reader) == 6


def test_the_key_of_the_environment_goes_only_to_its_coordinator(server, monkeypatch):
    monkeypatch.setenv("STICKSLIP_API_KEY", "secret")
    monkeypatch.setenv("STICKSLIP_URL", "https://stick.example.org/lab")
    server.key = "secret"
    with pytest.raises(SourceError, match=r"it belongs to the coordinator https://stick"):
        DatasetReader(_url(server))
    assert {key for key in server.keys_sent} == {None}


@pytest.mark.parametrize("value", ["", " "])
def test_an_empty_key_is_none(server, monkeypatch, value):
    monkeypatch.setenv("STICKSLIP_API_KEY", value)
    monkeypatch.setenv("STICKSLIP_URL", _url(server, ""))
    with DatasetReader(_url(server)) as reader:
        assert len(reader) == 6
    assert set(server.keys_sent) == {None}


def test_a_key_does_not_follow_a_redirect_to_another_server(server, monkeypatch):
    other = _Server(("127.0.0.1", 0), _Handler)
    other.root = server.root
    other.requests = []
    other.keys_sent = []
    thread = threading.Thread(target=other.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    server.redirect = _url(other, "")[:-1]
    try:
        with DatasetReader(_url(server), api_key="secret") as reader:
            assert len(reader) == 6
    finally:
        other.shutdown()
        thread.join()
        other.server_close()
    assert set(server.keys_sent) == {"Bearer secret"}
    assert set(other.keys_sent) == {None}


@pytest.mark.parametrize("name", ["http_proxy", "https_proxy", "all_proxy"])
def test_a_dead_proxy_does_not_stand_before_this_machine(server, monkeypatch, name):
    for variable in (name, name.upper()):
        monkeypatch.setenv(variable, "http://127.0.0.1:9")
    with DatasetReader(_url(server)) as reader:
        assert len(reader) == 6


def test_a_dead_proxy_before_another_machine_is_named(monkeypatch):
    monkeypatch.setenv("http_proxy", "http://me:hidden@127.0.0.1:9")
    with pytest.raises(SourceError) as caught:
        DatasetReader("http://stick.example.org/v1/datasets/ds-x/versions/1")
    message = str(caught.value)
    assert "through the proxy http://127.0.0.1:9 of the variable http_proxy" in message
    assert "hidden" not in message


@pytest.mark.parametrize("fault", ["endless", "gzip", "too long"])
def test_a_hostile_server_is_read_no_further_than_the_stated_size(server, fault):
    server.fault = fault
    with pytest.raises(CorruptDataError, match=r"compressed|accepted"):
        DatasetReader(_url(server))
    assert server.bytes_sent < 64 * 2**20


def test_a_server_without_ranges_is_refused(server):
    server.ranges = False
    with (
        DatasetReader(_url(server)) as reader,
        pytest.raises(SourceError, match="it does not serve ranges"),
    ):
        reader.read("views", [0])


def test_a_short_answer_is_refused(server):
    server.cut = 1
    with (
        DatasetReader(_url(server)) as reader,
        pytest.raises(CorruptDataError, match=r"sent \d+ bytes, and \d+"),
    ):
        reader.read("views", [0])


def test_a_missing_or_shorter_shard_raises(server, seen_rods, tmp_path):
    version = seen_rods.copy(tmp_path / "v1")
    server.root = version.root
    path = version.root / "views/c/1/0/0/0/0"
    with DatasetReader(_url(server)) as reader:
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(CorruptDataError):
            reader.read("views", [4])
        path.write_bytes(b"short")
        with pytest.raises(CorruptDataError, match="ends before byte"):
            reader.read("views", [4])
        path.unlink()
        with pytest.raises(MissingFileError, match="is not there, and the manifest says it is"):
            reader.read("views", [4])
