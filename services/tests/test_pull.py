"""Pulling and verifying: every byte checked, interruptions survived, nothing written outside."""

import random
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from stickslip_schemas.base import sha256
from stickslip_schemas.format.manifest import Contents, Manifest, seal_text, with_manifest_digest
from stickslip_services.app import make_app
from stickslip_services.client.errors import (
    DamagedError,
    ForeignFilesError,
    ProblemError,
    UnexpectedError,
    UnreachableError,
    UnsafePathError,
)
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import pull, refuse_foreign_files
from stickslip_services.client.verifying import safe_path, verify
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """URL and dataset of a coordinator that has published something."""
    app = make_app(Settings(data=tmp_path_factory.mktemp("origin"), durable=False))
    with serving(app) as url, Client(url) as client:
        worker = PretendWorker(DirectApi(app.state.context), app.state.context.store).register()
        job = client.submit(rods(), idempotency_key="one")
        worker.work()
        reference = client.job(job.id).dataset
        assert reference is not None
        yield url, reference.dataset


class Meddler(httpx.BaseTransport):
    """Passes requests on, and meddles with the answers to downloads of one file."""

    def __init__(
        self, path: str, meddle: Callable[[httpx.Request, httpx.Response], httpx.Response]
    ) -> None:
        self._inner = httpx.HTTPTransport()
        self._path = path
        self._meddle = meddle
        self.requests: list[httpx.Request] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        response = self._inner.handle_request(request)
        if not request.url.path.endswith(self._path):
            return response
        response.read()
        meddled = self._meddle(request, response)
        if isinstance(meddled.stream, Breaks):
            return meddled
        stream = httpx.ByteStream(meddled.content)  # it is read once more, as a stream
        return httpx.Response(meddled.status_code, headers=meddled.headers, stream=stream)

    def close(self) -> None:
        self._inner.close()


PATH = "/files/views/c/0/0"


class Breaks(httpx.SyncByteStream):
    """Sends some bytes, and then the connection is gone."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def __iter__(self) -> Iterator[bytes]:
        yield self._data
        raise httpx.ReadError("the connection is gone")


def test_a_pull_brings_everything_and_a_second_one_nothing(
    origin: tuple[str, str], tmp_path: Path
) -> None:
    url, dataset = origin
    meddler = Meddler("nothing", lambda _request, response: response)
    with Client(url, transport=meddler) as client:
        loaded: list[int] = []
        first = pull(client, dataset, 1, tmp_path / "d", on_bytes=loaded.append)
        assert first.files == first.downloaded_files == 8
        assert sum(loaded) == first.downloaded_bytes
        assert verify(tmp_path / "d") == []
        before = len(meddler.requests)
        second = pull(client, dataset, 1, tmp_path / "d")
        assert (second.downloaded_files, second.downloaded_bytes) == (0, 0)
        assert (
            len(meddler.requests) - before == 5
        )  # the version, the three files that vouch for it, and a signature
    assert not list((tmp_path / "d").rglob("*.part"))


def test_a_download_that_breaks_goes_on_where_it_stopped(
    origin: tuple[str, str], tmp_path: Path
) -> None:
    ranges: list[str | None] = []

    def meddle(request: httpx.Request, response: httpx.Response) -> httpx.Response:
        ranges.append(request.headers.get("range"))
        if len(ranges) <= 2:
            return httpx.Response(
                response.status_code,
                headers=response.headers,
                stream=Breaks(response.content[:100]),
            )
        return response

    with Client(origin[0], transport=Meddler(PATH, meddle), retry_timeout=0) as client:
        pull(client, origin[1], 1, tmp_path)
    assert ranges == [None, "bytes=100-", "bytes=200-"]
    assert verify(tmp_path) == []


def test_an_interrupted_pull_is_resumed_by_the_next(
    origin: tuple[str, str], tmp_path: Path
) -> None:
    def cut(request: httpx.Request, response: httpx.Response) -> httpx.Response:
        data = b"" if "range" in request.headers else response.content[:50]
        return httpx.Response(response.status_code, headers=response.headers, stream=Breaks(data))

    with (
        Client(origin[0], transport=Meddler(PATH, cut), retry_timeout=0) as client,
        pytest.raises(UnreachableError),
    ):
        pull(client, origin[1], 1, tmp_path)
    assert (tmp_path / "views/c/0/0.part").stat().st_size == 50
    assert not (tmp_path / "views/c/0/0").exists()
    assert [fault.path for fault in verify(tmp_path)] == ["manifest.json"]
    meddler = Meddler("nothing", lambda _request, response: response)
    with Client(origin[0], transport=meddler) as client:
        pull(client, origin[1], 1, tmp_path)
    resumed = [request for request in meddler.requests if request.url.path.endswith(PATH)]
    assert [request.headers.get("range") for request in resumed] == ["bytes=50-"]
    assert verify(tmp_path) == []


@pytest.mark.parametrize("left", [b"something else", b"x" * 100_000])
def test_a_part_of_something_else_is_thrown_away(
    origin: tuple[str, str], tmp_path: Path, left: bytes
) -> None:
    part = tmp_path / "views/c/0/0.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(left)
    with Client(origin[0]) as client:
        pull(client, origin[1], 1, tmp_path)
    assert verify(tmp_path) == []


def test_a_damaged_file_is_loaded_again(origin: tuple[str, str], tmp_path: Path) -> None:
    with Client(origin[0]) as client:
        pull(client, origin[1], 1, tmp_path)
        file = tmp_path / "views/c/0/0"
        data = bytearray(file.read_bytes())
        data[7] ^= 1
        file.write_bytes(data)
        (tmp_path / "mu" / "zarr.json").unlink()
        (tmp_path / "extra").write_text("mine")
        assert [(fault.path, fault.fault) for fault in verify(tmp_path)] == [
            ("extra", "extra"),
            ("mu/zarr.json", "missing"),
            ("views/c/0/0", "sha256"),
        ]
        assert pull(client, origin[1], 1, tmp_path).downloaded_files == 2
        assert [fault.fault for fault in verify(tmp_path)] == ["extra"]


def test_what_arrives_damaged_gets_no_name(origin: tuple[str, str], tmp_path: Path) -> None:
    def corrupt(_request: httpx.Request, response: httpx.Response) -> httpx.Response:
        return httpx.Response(200, content=b"\0" * len(response.content))

    with (
        Client(origin[0], transport=Meddler(PATH, corrupt), retry_timeout=0) as client,
        pytest.raises(DamagedError),
    ):
        pull(client, origin[1], 1, tmp_path)
    assert not (tmp_path / "views/c/0/0").exists()
    assert not (tmp_path / "manifest.json").exists()


@pytest.mark.parametrize(
    "path",
    [
        "a/../../b",
        "../b",
        "a/..",
        "a/./b",
        "/b",
        "a\\..\\b",
        "manifest.json",
        "a.part",
        "",
        ".git/hooks/x",
        "x/.git/hooks/post-checkout",
        "a/.b",
    ],
)
def test_a_path_that_leaves_the_dataset_is_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(UnsafePathError):
        safe_path(tmp_path / "d", path)


def test_a_link_that_leaves_the_dataset_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "views").symlink_to(tmp_path)
    with pytest.raises(UnsafePathError):
        safe_path(tmp_path / "d", "views/x")


def test_a_malicious_manifest_writes_nothing(origin: tuple[str, str], tmp_path: Path) -> None:
    """The manifest's own model allows `a/../../b`; the client does not."""
    with Client(origin[0]) as client:
        manifest = client.contents(origin[1], 1).manifest
    evil_file = manifest.files[0].model_copy(update={"path": "a/../../evil"})
    evil = manifest.model_copy(update={"files": (evil_file,)}).model_dump_json().encode()
    assert Manifest.model_validate_json(evil)
    group = with_manifest_digest(b"{}", sha256(evil))
    answers = {
        "zarr.json": group,
        "manifest.sha256": seal_text(sha256(evil), sha256(group)),
        "manifest": evil,
    }

    def lie(request: httpx.Request, response: httpx.Response) -> httpx.Response:
        name = request.url.path.rpartition("/")[2]
        if name in answers:
            return httpx.Response(200, content=answers[name])
        if request.url.path.endswith("/versions/1"):
            return httpx.Response(
                200, json=response.json() | {"manifest": sha256(evil), "group": sha256(group)}
            )
        return response

    with Client(origin[0], transport=Meddler("", lie)) as client, pytest.raises(UnsafePathError):
        pull(client, origin[1], 1, tmp_path / "d")
    assert list(tmp_path.iterdir()) == []


def test_a_manifest_other_than_promised_is_refused(origin: tuple[str, str], tmp_path: Path) -> None:
    def lie(_request: httpx.Request, response: httpx.Response) -> httpx.Response:
        return httpx.Response(
            200, content=response.content.replace(b"rod_hang", b"rod_hang", 1) + b"\n"
        )

    with (
        Client(origin[0], transport=Meddler("/manifest", lie)) as client,
        pytest.raises(DamagedError),
    ):
        pull(client, origin[1], 1, tmp_path)


def test_a_coordinator_that_is_away_is_waited_for() -> None:
    answers: Iterator[httpx.Response | Exception] = iter(
        [
            httpx.Response(503),
            httpx.ConnectError("refused"),
            httpx.ReadError("gone"),
            httpx.Response(200, json=[]),
        ]
    )
    slept: list[float] = []

    def answer(_request: httpx.Request) -> httpx.Response:
        item = next(answers)
        if isinstance(item, httpx.Response):
            return item
        raise item

    with Client(transport=httpx.MockTransport(answer), sleep=slept.append) as client:
        assert client.workers() == []
    assert len(slept) == 3
    always = httpx.MockTransport(lambda _request: httpx.Response(503))
    with (
        Client(transport=always, retry_timeout=0) as client,
        pytest.raises(UnexpectedError, match="503"),
    ):
        client.workers()


def test_a_coordinator_that_is_not_there_is_not_waited_for() -> None:
    def refuse(_request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("refused")

    slept: list[float] = []
    transport = httpx.MockTransport(refuse)
    with (
        Client(transport=transport, sleep=slept.append) as client,
        pytest.raises(UnreachableError, match="refused"),
    ):
        client.workers()
    assert slept == []


def test_a_problem_is_an_exception_with_all_it_says(origin: tuple[str, str]) -> None:
    with Client(origin[0]) as client, pytest.raises(ProblemError) as caught:
        client.submit(
            {"kind": "rod_hang", "axes": {"gamma": -1.0, "phi0": 0.0, "phi1": 0.0}},
            idempotency_key="bad",
        )
    (field,) = caught.value.problem.errors
    assert (field.pointer, field.value) == ("/axes/gamma", "-1.0")


SEALED = ("manifest.json", "zarr.json", "manifest.sha256")


def flipped(data: bytes, rng: random.Random) -> bytes:
    position = rng.randrange(len(data))
    return data[:position] + bytes([data[position] ^ 1 << rng.randrange(8)]) + data[position + 1 :]


@pytest.mark.physics
def test_no_flipped_bit_of_the_sealed_files_is_silent(
    origin: tuple[str, str], tmp_path: Path
) -> None:
    with Client(origin[0]) as client:
        pull(client, origin[1], 1, tmp_path)
    rng = random.Random(7)
    for name in SEALED:
        path = tmp_path / name
        whole = path.read_bytes()
        for _ in range(700):
            path.write_bytes(flipped(whole, rng))
            assert [fault.path for fault in verify(tmp_path)] in (
                ["manifest.sha256"],
                ["manifest.json"],
            )
        path.write_bytes(whole)
    assert verify(tmp_path) == []


@pytest.mark.parametrize("name", ["manifest", "zarr.json", "manifest.sha256"])
def test_no_flipped_bit_arrives_in_silence(
    origin: tuple[str, str], tmp_path: Path, name: str
) -> None:
    rng = random.Random(8)

    def flip(_request: httpx.Request, response: httpx.Response) -> httpx.Response:
        return httpx.Response(200, content=flipped(response.content, rng))

    with Client(origin[0], transport=Meddler(f"/{name}", flip), retry_timeout=0) as client:
        for _ in range(20):
            with pytest.raises((DamagedError, UnexpectedError)):
                pull(client, origin[1], 1, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.physics
def test_swapped_shards_are_found(origin: tuple[str, str], tmp_path: Path) -> None:
    with Client(origin[0]) as client:
        pull(client, origin[1], 1, tmp_path)
    rng = random.Random(9)
    sizes: dict[int, list[Path]] = {}
    for path in tmp_path.rglob("c/*/0"):
        sizes.setdefault(path.stat().st_size, []).append(path)
    pairs = [group for group in sizes.values() if len(group) > 1]
    assert pairs
    for _ in range(200):
        first, other = rng.sample(rng.choice(pairs), 2)
        contents = first.read_bytes(), other.read_bytes()
        other.write_bytes(contents[0]), first.write_bytes(contents[1])
        damaged = {fault.path for fault in verify(tmp_path)}
        assert damaged == {path.relative_to(tmp_path).as_posix() for path in (first, other)}
        first.write_bytes(contents[0]), other.write_bytes(contents[1])


def test_keys_that_the_manifest_does_not_list_are_found(
    origin: tuple[str, str], tmp_path: Path
) -> None:
    """A manifest and its seal made anew, consistent in themselves, over the arrays of another
    dataset.
    """
    with Client(origin[0]) as client:
        pull(client, origin[1], 1, tmp_path)
    manifest = Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes())
    keys = (manifest.sample_keys[1], manifest.sample_keys[0], *manifest.sample_keys[2:])
    content = manifest.model_copy(update={"sample_keys": keys}).model_dump_json().encode()
    group = with_manifest_digest((tmp_path / "zarr.json").read_bytes(), sha256(content))
    for name, data in zip(
        SEALED, (content, group, seal_text(sha256(content), sha256(group))), strict=True
    ):
        (tmp_path / name).write_bytes(data)
    (fault,) = verify(tmp_path)
    assert (fault.path, fault.fault) == ("sample_key/c/0/0", "sample_key")
    assert "slots 0 to 3" in fault.detail


def test_files_of_something_else_are_not_mixed_with_a_dataset(
    origin: tuple[str, str], tmp_path: Path
) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/thesis.txt").write_text("mine")
    with (
        Client(origin[0]) as client,
        pytest.raises(ForeignFilesError, match=r"1 file is .*notes/thesis\.txt"),
    ):
        pull(client, origin[1], 1, tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == ["notes", "thesis.txt"]


def test_a_dataset_is_not_mixed_with_another(origin: tuple[str, str], tmp_path: Path) -> None:
    with Client(origin[0]) as client:
        pull(client, origin[1], 1, tmp_path)
    manifest = Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes())
    fewer = Contents(manifest.model_copy(update={"files": manifest.files[1:]}), lambda _: b"")
    with pytest.raises(ForeignFilesError, match=rf"It holds {manifest.dataset}:v1\."):
        refuse_foreign_files(tmp_path, fewer, "ds-other:v1")
