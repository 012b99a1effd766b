"""A store in a bucket, over a network and a server that fail."""

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from stickslip_schemas.base import sha256
from stickslip_schemas.store import is_unavailable

pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
pytest.importorskip("moto", reason="moto is not installed: make setup-dev")

import obstore
import obstore.exceptions
from stickslip_schemas.store.bucket import BucketStore
from stickslip_testing.s3 import Proxy, make_bucket, no_fault, s3_proxy, variables

pytestmark = pytest.mark.real

SMALL = np.random.default_rng(1).bytes(100_000)
LARGE = np.random.default_rng(2).bytes(3_000_000)
FAULTS = ("503", "409", "500", "late", "torn upload", "torn download", "lost answer")


@pytest.fixture(scope="module")
def server() -> Iterator[Proxy]:
    with s3_proxy() as proxy:
        make_bucket(proxy, "bucket")
        yield proxy


@pytest.fixture
def proxy(
    server: Proxy, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Proxy]:
    for variable, value in variables(server).items():
        monkeypatch.setenv(variable, value)
    server.fault = no_fault
    server.counts.clear()
    yield server
    server.fault = no_fault


@pytest.fixture
def store(proxy: Proxy, request: pytest.FixtureRequest) -> BucketStore:
    return BucketStore("bucket", request.node.name)


def test_a_bucket_without_a_request_for_many_deletes_one_by_one(
    proxy: Proxy, store: BucketStore
) -> None:
    remaining, gone = store.publish(SMALL), store.publish(LARGE)
    store.show(gone, "dataset", 1, "a")
    store.show(gone, "dataset", 1, "b")
    proxy.fault = lambda method, path: "501" if method == "POST" and "delete" in path else ""
    store.delete(gone)
    store.hide("dataset", 1)
    assert proxy.counts["501"] > 0
    assert not store.is_shown("dataset", 1)
    assert [artifact.name for artifact in store.stored()] == [remaining]


@pytest.mark.parametrize("fault", FAULTS)
def test_every_request_may_fail_once(proxy: Proxy, store: BucketStore, fault: str) -> None:
    for data in (SMALL, LARGE):
        for step in (
            store.publish,
            lambda data: store.read(sha256(data)),
            lambda data: store.size(sha256(data)),
        ):
            failed_once: set[tuple[str, str]] = set()

            def once(
                method: str, path: str, failed_once: set[tuple[str, str]] = failed_once
            ) -> str:
                is_first = (method, path) not in failed_once
                failed_once.add((method, path))
                return fault if is_first else ""

            proxy.fault = once
            step(data)
            assert failed_once
        proxy.fault = no_fault
        assert store.read(sha256(data)) == data
    assert proxy.counts[fault] >= 4


def test_a_torn_upload_is_never_visible(proxy: Proxy) -> None:
    impatient = BucketStore("bucket", "torn", retry_timeout=0.5)
    for k in range(10):
        data = LARGE + bytes([k])
        proxy.fault = lambda method, path: "torn upload" if method == "PUT" else ""
        with pytest.raises(OSError, match="s3://bucket/torn") as caught:
            impatient.publish(data)
        assert is_unavailable(caught.value)
        proxy.fault = no_fault
        assert not impatient.exists(sha256(data))
    assert list(impatient.stored()) == []
    assert proxy.counts["torn upload"] >= 10


def test_a_server_that_stays_away_is_unavailable(proxy: Proxy) -> None:
    impatient = BucketStore("bucket", "away", retry_timeout=0.5)
    digest = impatient.publish(SMALL)
    proxy.fault = lambda method, path: "503"
    for ask in (
        lambda: impatient.publish(LARGE),
        lambda: impatient.read(digest),
        lambda: impatient.exists(digest),  # not False: then a result would be thrown away
        lambda: impatient.holds(digest),
        impatient.probe,
    ):
        with pytest.raises(OSError, match="s3://bucket/away") as caught:
            ask()
        assert is_unavailable(caught.value)


def test_a_bucket_that_is_not_there_is_unavailable(proxy: Proxy) -> None:
    with pytest.raises(OSError, match="the bucket of s3://nobody/x does not exist") as caught:
        BucketStore("nobody", "x").publish(SMALL)
    assert is_unavailable(caught.value)


def test_one_conditional_put_of_many_wins(proxy: Proxy, store: BucketStore) -> None:
    """What `publish` builds on, 25 times with 8 writers of different bytes."""

    def put(name: str, number: int) -> int | None:
        try:
            obstore.put(
                store._objects._store,
                name,
                bytes([number]) * 1000,
                mode="create",
                use_multipart=False,
            )
            return number
        except obstore.exceptions.AlreadyExistsError:
            return None

    for race in range(25):
        with ThreadPoolExecutor(8) as writers:
            results = list(
                writers.map(lambda number, name=f"race-{race}": put(name, number), range(8))
            )
        (winner,) = [number for number in results if number is not None]
        assert store._objects.get(f"race-{race}") == bytes([winner]) * 1000


def test_what_is_there_is_not_sent_again(proxy: Proxy, store: BucketStore) -> None:
    store.publish(LARGE)
    proxy.counts.clear()
    assert store.publish(LARGE) == sha256(LARGE)
    assert proxy.counts["PUT"] == 0
    assert proxy.counts["GET"] == 0
    assert 1 <= proxy.counts["HEAD"] <= 2


def test_much_goes_wrong_at_once_and_nothing_is_lost(proxy: Proxy, store: BucketStore) -> None:
    proxy.inject_faults(3, dict.fromkeys(FAULTS, 0.04))
    artifacts = [SMALL[: 1000 * (k + 1)] for k in range(50)]
    with ThreadPoolExecutor(4) as writers:
        digests = list(writers.map(store.publish, artifacts * 2))
        assert digests == [sha256(data) for data in artifacts * 2]
        assert list(writers.map(store.read, digests[:50])) == artifacts
        list(writers.map(lambda k: store.show(digests[k], "ds-1", 1, f"c/{k}"), range(50)))
    happened = Counter({fault: proxy.counts[fault] for fault in FAULTS})
    proxy.fault = no_fault
    assert sorted(artifact.name for artifact in store.stored()) == sorted(set(digests))
    assert all(store.shows(digests[k], "ds-1", 1, f"c/{k}") for k in range(50))
    assert happened.total() >= 20
    assert all(happened[fault] > 0 for fault in FAULTS)
