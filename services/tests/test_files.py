"""Files of datasets over HTTP: ranges, validators, digests, and nothing but what the manifest
names.
"""

import base64
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import httpx
import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.store import DirectoryStore
from stickslip_services.app import make_app
from stickslip_services.client import Client, ProblemError
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker


@dataclass
class Published:
    client: httpx.Client
    store: DirectoryStore
    root: str
    url: str

    @property
    def manifest(self) -> Manifest:
        return Manifest.model_validate_json(self.client.get(f"{self.root}/manifest").content)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Published]:
    app = make_app(Settings(data=tmp_path_factory.mktemp("files"), durable=False))
    with serving(app) as url, httpx.Client(base_url=url) as client:
        context = app.state.context
        worker = PretendWorker(DirectApi(context), context.store).register()
        job = client.post("/v1/jobs", json=rods()).json()["id"]
        worker.work()
        dataset = client.get(f"/v1/jobs/{job}").json()["dataset"]["dataset"]
        root = f"/v1/datasets/{dataset}/versions/1"
        yield Published(client, context.store, root, url + root)


PATH = "views/c/0/0"


def content(published: Published, path: str = PATH) -> bytes:
    (file,) = [file for file in published.manifest.files if file.path == path]
    return published.store.read(file.sha256)


def test_a_whole_file(published: Published) -> None:
    response = published.client.get(f"{published.root}/files/{PATH}")
    data = content(published)
    digest = hashlib.sha256(data)
    assert (response.status_code, response.content) == (200, data)
    assert response.headers["etag"] == f'"{digest.hexdigest()}"'
    assert (
        response.headers["repr-digest"] == f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
    )
    assert response.headers["content-length"] == str(len(data))
    assert "immutable" in response.headers["cache-control"]
    head = published.client.head(f"{published.root}/files/{PATH}")
    assert (head.status_code, head.content) == (200, b"")
    for name in ("etag", "repr-digest", "content-length", "accept-ranges", "content-type"):
        assert head.headers[name] == response.headers[name]


@pytest.mark.parametrize(
    ("header", "part"),
    [
        ("bytes=0-9", slice(0, 10)),
        ("bytes=10-", slice(10, None)),
        ("bytes=-7", slice(-7, None)),
        ("bytes=5-999999999", slice(5, None)),
        ("bytes=-999999999", slice(None)),
        ("bytes=0-0", slice(0, 1)),
    ],
)
def test_a_range(published: Published, header: str, part: slice) -> None:
    data = content(published)
    response = published.client.get(f"{published.root}/files/{PATH}", headers={"Range": header})
    assert (response.status_code, response.content) == (206, data[part])
    first = data.index(data[part]) if part.start != -7 else len(data) - 7
    assert (
        response.headers["content-range"]
        == f"bytes {first}-{first + len(data[part]) - 1}/{len(data)}"
    )
    whole = published.client.head(f"{published.root}/files/{PATH}").headers
    assert (response.headers["repr-digest"], response.headers["etag"]) == (
        whole["repr-digest"],
        whole["etag"],
    )


@pytest.mark.parametrize("header", ["bytes=99999999-", "bytes=-0"])
def test_a_range_outside_the_file(published: Published, header: str) -> None:
    response = published.client.get(f"{published.root}/files/{PATH}", headers={"Range": header})
    assert response.status_code == 416
    assert response.headers["content-range"] == f"bytes */{len(content(published))}"
    assert response.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "header", ["bytes=5-2", "bytes=-", "bytes=a-b", "lines=0-1", "bytes=0-1,4-5", ""]
)
def test_a_range_that_is_none_is_ignored(published: Published, header: str) -> None:
    response = published.client.get(f"{published.root}/files/{PATH}", headers={"Range": header})
    assert (response.status_code, response.content) == (200, content(published))


def test_a_range_of_another_file_gets_the_whole(published: Published) -> None:
    url = f"{published.root}/files/{PATH}"
    etag = published.client.head(url).headers["etag"]
    for validator, status in (
        (etag, 206),
        ('"other"', 200),
        ("W/" + etag, 200),
        ("Sat, 29 Oct 1994 19:43:31 GMT", 200),
    ):
        response = published.client.get(url, headers={"Range": "bytes=0-3", "If-Range": validator})
        assert response.status_code == status, validator


def test_what_the_client_has_is_not_sent(published: Published) -> None:
    url = f"{published.root}/files/{PATH}"
    etag = published.client.head(url).headers["etag"]
    for value, status in ((etag, 304), (f'"a", W/{etag}', 304), ("*", 304), ('"a"', 200)):
        assert published.client.get(url, headers={"If-None-Match": value}).status_code == status


@pytest.mark.parametrize(
    "path",
    [
        "nothing",
        "views/c/0",
        "views/c/0/0/",
        "..%2f..%2f..%2fcoordinator.sqlite3",
        "%2e%2e/%2e%2e/coordinator.sqlite3",
        "/etc/passwd",
        "%00",
        "views/c/0/0%00",
        "views//c/0/0",
        "",
    ],
)
def test_only_files_of_the_manifest_are_served(published: Published, path: str) -> None:
    response = published.client.get(f"{published.root}/files/{path}")
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"


def test_the_manifest_is_a_file_too(published: Published) -> None:
    first = published.client.get(f"{published.root}/manifest")
    second = published.client.get(f"{published.root}/files/manifest.json")
    assert first.content == second.content
    assert (
        first.headers["etag"]
        == second.headers["etag"]
        == f'"{hashlib.sha256(first.content).hexdigest()}"'
    )
    assert first.headers["content-type"] == "application/json"
    assert published.client.get(f"{published.root[:-1]}2/manifest").status_code == 404


def test_a_file_that_is_gone_or_damaged_is_a_problem(published: Published) -> None:
    (file,) = [file for file in published.manifest.files if file.path == "views/c/1/0"]
    place = published.store.path(file.sha256)
    data = place.read_bytes()
    place.write_bytes(data[:-1])
    damaged = published.client.get(f"{published.root}/files/views/c/1/0")
    place.unlink()
    gone = published.client.get(f"{published.root}/files/views/c/1/0")
    place.write_bytes(data)
    for response in (damaged, gone):
        assert (response.status_code, response.json()["code"]) == (500, "storage_error")


def test_zarr_readers_open_the_url(published: Published) -> None:
    url = f"{published.url}/files/"
    group = zarr.open_group(url, mode="r")
    assert np.array_equal(np.asarray(group["mu"]), np.arange(4.0))
    spec = {"driver": "zarr3", "kvstore": f"{url}mu/"}
    assert np.array_equal(tensorstore.open(spec).result().read().result(), np.arange(4.0))
    with xarray.open_zarr(url, consolidated=True) as dataset:
        assert dataset["mu"].dims == ("sample",)
        assert float(dataset["mu"].sum()) == 6.0


def test_the_client_opens_a_dataset(published: Published) -> None:
    with Client(str(published.client.base_url)) as client:
        opened = client.open(published.manifest.dataset)
        assert np.array_equal(np.asarray(opened["mu"]), np.arange(4.0))
        with pytest.raises(ProblemError, match="version 9"):
            client.open(published.manifest.dataset, 9)
