"""Reading over HTTP, from a real server on a local port."""

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
from stickslip_training.data.sources import (
    CorruptDataError,
    HttpSource,
    MissingFileError,
    SourceError,
)


class _Server(http.server.ThreadingHTTPServer):
    root: Path
    requests: list[tuple[str, str | None]]
    ranges = True
    failures = 0  # so many requests are answered 503 first
    key: str | None = None
    cut = 0  # so many bytes less in every body of a range


class _Handler(http.server.BaseHTTPRequestHandler):
    """Serve the files of a dataset version as the service does, with ranges."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # header and body are two writes
    server: _Server

    def do_GET(self):
        self.server.requests.append((self.path, self.headers["Range"]))
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

    def log_message(self, *_):
        pass


@pytest.fixture
def server(seen_rods) -> Iterator[_Server]:
    server = _Server(("127.0.0.1", 0), _Handler)
    server.root = seen_rods.root
    server.requests = []
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
    monkeypatch.setattr(HttpSource, "TRIES", 2)
    server.failures = 100
    with pytest.raises(SourceError, match=r"manifest.json answered 503, and 200 was expected"):
        DatasetReader(_url(server))
    with pytest.raises(SourceError, match="does not answer: ConnectError"):
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
    with DatasetReader(_url(server)) as reader:
        assert len(reader) == 6


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
    made = seen_rods.copy(tmp_path / "v1")
    server.root = made.root
    path = made.root / "views/c/1/0/0/0/0"
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
