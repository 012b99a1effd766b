"""Tenants: what belongs to another project is not there, whatever the operation.

Every operation of the OpenAPI document, and every page, is tried with the key of another project.
One that is added and not tried fails the test.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI, Response
from PIL import Image
from sqlalchemy import insert, select
from starlette.routing import Route
from stickslip_schemas.base import JobState
from stickslip_services.access.keys import create_key
from stickslip_services.access.principals import Principal, Scope, acting_as
from stickslip_services.app import make_app
from stickslip_services.catalog.versions import list_datasets
from stickslip_services.database.database import PageRequest
from stickslip_services.database.tables import dataset_versions, datasets, previews, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import task_id
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.nginx import nginx
from stickslip_testing.servers import serving, wait_until
from stickslip_testing.worker import DirectApi, PretendWorker

SHARED = {
    ("GET", "/livez"),
    ("GET", "/readyz"),
    ("GET", "/v1/certificates"),
    ("GET", "/v1/datasets"),
    ("GET", "/v1/jobs"),
    ("GET", "/v1/workers"),
    ("POST", "/v1/files"),
    ("POST", "/v1/jobs"),
    ("POST", "/v1/jobs:validate"),
    ("POST", "/v1/textures"),
    ("GET", "/"),
    ("GET", "/certificates"),
    ("GET", "/datasets"),
    ("GET", "/docs"),
    ("GET", "/scenes"),
    ("GET", "/submit"),
    ("GET", "/workers"),
    ("POST", "/ui/submit"),
    ("POST", "/ui/submit/check"),
}
"""Operations that every project may call. They must tell nothing of another project."""

HOUSE = {
    ("GET", "/metrics"): 404,
    ("GET", "/v1/certificates/{digest}"): 404,  # there is none here; they belong to no project
    ("GET", "/certificates/{digest}"): 404,
    ("GET", "/scenes/{digest}"): 404,
    ("POST", "/v1/certificates"): 403,
    ("POST", "/v1/workers"): 403,
    ("POST", "/v1/worker/lease"): 403,
    ("POST", "/v1/worker/heartbeat"): 403,
    ("POST", "/v1/worker/report"): 403,
}
"""Operations that are not of a project, and what its key gets."""

ENDLESS = {("GET", "/ui/changes")}
"""A stream without contents: it says that anything has changed, and not what."""

OWNED = {
    *(("GET", f"/v1/jobs/{{job_id}}{rest}") for rest in ("", "/samples", "/previews", "/events")),
    ("PATCH", "/v1/jobs/{job_id}"),
    *(("POST", f"/v1/jobs/{{job_id}}:{verb}") for verb in ("cancel", "pause", "resume")),
    ("GET", "/v1/tasks/{task_id}"),
    ("GET", "/jobs/{job_id}/tasks/{task_id}"),
    ("POST", "/v1/jobs/{job_id}/tasks/{task_id}:retry"),
    ("POST", "/ui/jobs/{job_id}/tasks/{task_id}/retry"),
    ("GET", "/v1/previews/{digest}"),
    ("GET", "/v1/datasets/{dataset}"),
    *(
        (method, f"/v1/datasets/{{dataset}}/versions/{{version}}{rest}")
        for method in ("GET", "HEAD")
        for rest in ("", "/manifest", "/files/{path:path}")
    ),
    ("GET", "/jobs/{job_id}"),
    *(("GET", f"/ui/jobs/{{job_id}}/{part}") for part in ("map", "slowest")),
    ("POST", "/ui/jobs/{job_id}/{verb}"),
    ("GET", "/datasets/{dataset}"),
    ("GET", "/datasets/{dataset}/v{version}"),
    ("GET", "/datasets/{dataset}/v{version}/samples/{slot}"),
    *(
        ("GET", f"/ui/datasets/{{dataset}}/v{{version}}/{rest}")
        for rest in (
            "thumbs",
            "cover.png",
            "selection.zip",
            "spec.yaml",
            "samples/{slot}/motion.json",
            "samples/{slot}/{array}.mp4",
            "samples/{slot}/{array}/{index}.png",
        )
    ),
}
"""Operations on a thing of a project: 404 for the others."""


@dataclass
class Tenants:
    """A coordinator with a job, a dataset and an upload of the project alpha, and keys of two
    projects.
    """

    app: FastAPI
    alpha: httpx.Client
    beta: httpx.Client
    parameters: dict[str, str]
    upload: str

    def call(self, client: httpx.Client, method: str, template: str) -> httpx.Response:
        path = template.replace("{path:path}", "{path}").format(**self.parameters)
        if template.endswith("/files"):
            return client.post(path, content=b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        if template.endswith("/textures"):
            return client.post(path, content=picture(3), headers={"Content-Type": "image/png"})
        if method == "POST" and template.startswith("/ui/submit"):
            return client.post(path, data={"kind": "rod_hang"})
        bodies = {"PATCH": {"priority": 3}, "POST": rods()}
        return client.request(method, path, json=bodies.get(method))


def picture(shade: int) -> bytes:
    file = BytesIO()
    Image.new("RGB", (64, 64), (shade, 20, 20)).save(file, format="PNG")
    return file.getvalue()


@pytest.fixture(scope="module")
def tenants(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tenants]:
    with serving_tenants(tmp_path_factory.mktemp("tenants")) as served:
        yield served


@contextmanager
def serving_tenants(folder: Path) -> Iterator[Tenants]:
    app = make_app(Settings(data=folder, durable=False, require_keys=True))
    context: Context = app.state.context
    with serving(app) as url:
        with context.database.write() as connection:
            secrets = {
                name: create_key(connection, name, [Scope.submit], time.time(), project=name)[1]
                for name in ("alpha", "beta")
            }
        clients = {
            name: httpx.Client(
                base_url=url,
                headers={"Authorization": f"Bearer {secret}"},
                timeout=20,
                trust_env=False,
            )
            for name, secret in secrets.items()
        }
        alpha = clients["alpha"]
        worker = PretendWorker(DirectApi(context), context.store, whole=True).register()
        response = alpha.post(
            "/v1/jobs", json=rods(name="alpha-s"), headers={"Idempotency-Key": "one"}
        ).json()
        worker.work()
        upload = alpha.post(
            "/v1/textures", content=picture(7), headers={"Content-Type": "image/png"}
        ).json()
        job = alpha.get(f"/v1/jobs/{response['id']}").json()
        assert job["state"] == "succeeded", job
        with context.database.read() as connection:
            stage, key = connection.execute(select(tasks.c.stage, tasks.c.key).limit(1)).one()
            preview = connection.scalar(select(previews.c.digest).limit(1))
        assert preview is not None
        parameters = {
            "job_id": job["id"],
            "task_id": task_id(stage, key),
            "digest": preview,
            "dataset": job["dataset"]["dataset"],
            "version": "1",
            "path": "zarr.json",
            "verb": "cancel",
            "slot": "0",
            "array": "mu",
            "index": "0",
        }
        yield Tenants(app, alpha, clients["beta"], parameters, upload["texture"])
        for client in clients.values():
            client.close()


def operations(app: FastAPI) -> set[tuple[str, str]]:
    """Return all operations (method, template), those outside the OpenAPI document included."""
    nested = [getattr(route, "original_router", None) for route in app.state.routes]
    all_routes = [
        *app.state.routes,
        *(route for router in nested if router for route in router.routes),
    ]
    routes = {
        (method, route.path)
        for route in all_routes
        if isinstance(route, Route)
        for method in route.methods or ()
    }
    document = {
        (method.upper(), path)
        for path, methods in app.openapi()["paths"].items()
        for method in methods
    }
    assert document <= {(method, path.replace("{path:path}", "{path}")) for method, path in routes}
    return routes


def test_every_operation_is_tried(tenants: Tenants) -> None:
    there = {(method, path) for method, path in operations(tenants.app) if method != "HEAD"}
    tried = {
        (method, path)
        for method, path in SHARED | HOUSE.keys() | ENDLESS | OWNED
        if method != "HEAD"
    }
    assert there == tried, f"not tried: {there - tried}; not there: {tried - there}"


@pytest.mark.parametrize(("method", "path"), sorted(OWNED))
def test_what_belongs_to_another_project_is_not_found(
    tenants: Tenants, method: str, path: str
) -> None:
    refused = tenants.call(tenants.beta, method, path)
    if (method, path) not in operations(tenants.app):
        assert refused.status_code == 405
        return
    assert refused.status_code == 404, refused.text
    allowed = tenants.call(tenants.alpha, method, path)
    assert allowed.status_code != 404 or "array" in path, (
        allowed.text
    )  # rods have no pictures of that name
    assert (
        refused.text.replace(refused.headers["x-request-id"], "") not in allowed.text
        or method == "HEAD"
    )


@pytest.mark.parametrize(("method", "path"), sorted(SHARED))
def test_lists_tell_nothing_of_another_project(tenants: Tenants, method: str, path: str) -> None:
    answer = tenants.call(tenants.beta, method, path)
    assert answer.is_success, answer.text
    secret = ("job_id", "task_id", "digest")
    if (method, path) != ("POST", "/v1/jobs:validate"):
        for name in secret:
            assert tenants.parameters[name] not in answer.text, (name, answer.text)
    assert "alpha" not in answer.text


def may_be_kept_by_a_shared_cache(answer: httpx.Response) -> bool:
    """Whether a proxy between the coordinator and several users may store an answer [RFC 9111, 3].

    Every status can be stored: a proxy may take `public` or `max-age` of any of them, and some
    (200, 301, 404, 405 ...) without a word. So only an explicit `private` or `no-store` keeps an
    answer out, and `public` or `s-maxage` beside it is a contradiction.
    """
    words = answer.headers.get("cache-control", "").lower().split(",")
    directives = {word.strip().partition("=")[0] for word in words}
    is_closed = bool(directives & {"private", "no-store"})
    return not is_closed or bool(directives & {"public", "s-maxage"})


@pytest.mark.parametrize("reader", ["owner", "another project", "wrong key", "nobody"])
def test_no_answer_that_needs_a_key_is_kept_by_a_shared_cache(
    tenants: Tenants, reader: str
) -> None:
    """All operations, also those that the method or the path of the resource does not allow."""
    authorization = {
        "owner": tenants.alpha.headers["Authorization"],
        "another project": tenants.beta.headers["Authorization"],
        "wrong key": "Bearer sk_wrong",
        "nobody": None,
    }[reader]
    headers = {} if authorization is None else {"Authorization": authorization}
    templates = {path for _, path in operations(tenants.app)} - {path for _, path in ENDLESS}
    open_to_all = {"/livez", "/readyz"}
    with httpx.Client(
        base_url=tenants.alpha.base_url, headers=headers, timeout=20, trust_env=False
    ) as client:
        calls = [
            (method, template)
            for template in [*sorted(templates), "/v1/nothing", "/nothing"]
            for method in ("GET", "HEAD", "OPTIONS", "DELETE")
        ]
        for method, template in calls:
            answer = tenants.call(client, method, template)
            summary = f"{method} {template}: {answer.status_code} {answer.headers}"
            assert not may_be_kept_by_a_shared_cache(answer), summary
            assert "authorization" in answer.headers.get("vary", "").lower(), summary
            if reader in ("nobody", "wrong key") and template not in open_to_all:
                assert answer.status_code == 401, summary


def counting_app() -> FastAPI:
    """Return an app whose only answer may be kept by a shared cache, and counts its calls."""
    app = FastAPI()
    calls = []

    @app.get("/public")
    def public(response: Response) -> int:
        calls.append(1)
        response.headers["Cache-Control"] = "public, max-age=600"
        return len(calls)

    return app


CACHING = """
proxy_http_version 1.1;
proxy_set_header Host $http_host;
proxy_cache shared;
proxy_cache_valid any 10m;
add_header X-Cache $upstream_cache_status always;
"""
"""A cache that also keeps answers which say nothing of caches."""


@pytest.mark.real
def test_a_caching_proxy_gives_nobody_what_the_owner_has_read(tmp_path: Path) -> None:
    """nginx caches what it may; every path is read by the owner first, twice."""
    # The jobs of other tests make the other project an owner, too.
    with serving_tenants(tmp_path / "data") as tenants:
        read_through_a_cache(tenants, tmp_path)


def read_through_a_cache(tenants: Tenants, folder: Path) -> None:
    templates = {path for method, path in operations(tenants.app) if method == "GET"} - {
        path for _, path in ENDLESS
    }
    alpha, beta = (client.headers["Authorization"] for client in (tenants.alpha, tenants.beta))
    readers = {"another project": beta, "wrong key": "Bearer sk_wrong", "nobody": None}
    service = str(tenants.alpha.base_url).rstrip("/")
    with serving(counting_app()) as public:
        locations = (
            f"location / {{ proxy_pass {service}; {CACHING} }}"
            f"location = /public {{ proxy_pass {public}; {CACHING} }}"
        )
        zone = f"proxy_cache_path {folder}/cache keys_zone=shared:1m;"
        with (
            nginx(folder, server=locations, http=zone) as address,
            httpx.Client(base_url=address, timeout=20, trust_env=False) as client,
        ):
            # The proxy caches: otherwise the test would show nothing.
            assert [client.get("/public").text for _ in range(2)] == ["1", "1"]
            for template in sorted(templates):
                client.headers["Authorization"] = alpha
                for _ in range(2):
                    answer = tenants.call(client, "GET", template)
                    assert answer.headers["X-Cache"] != "HIT", template
                for reader, authorization in readers.items():
                    client.headers.pop("Authorization", None)
                    if authorization is not None:
                        client.headers["Authorization"] = authorization
                    answer = tenants.call(client, "GET", template)
                    summary = f"{reader}: {template}: {answer.status_code} {answer.headers}"
                    assert answer.headers["X-Cache"] != "HIT", summary
                    if ("GET", template) in OWNED:
                        expected = {404} if reader == "another project" else {401}
                        assert answer.status_code in expected, summary
                    elif reader != "another project" and template not in ("/livez", "/readyz"):
                        assert answer.status_code == 401, summary
                    assert tenants.parameters["job_id"] not in answer.text or (
                        tenants.parameters["job_id"] in str(answer.url)
                    ), summary


def test_a_file_is_private_in_every_form_of_its_answer(tenants: Tenants) -> None:
    path = "/v1/datasets/{dataset}/versions/{version}/files/zarr.json".format(**tenants.parameters)
    etag = tenants.alpha.get(path).headers["ETag"]
    for headers, status in (
        ({}, 200),
        ({"Range": "bytes=0-3"}, 206),
        ({"If-None-Match": etag}, 304),
        ({"Range": "bytes=999999999-"}, 416),
    ):
        answer = tenants.alpha.get(path, headers=headers)
        assert answer.status_code == status
        assert not may_be_kept_by_a_shared_cache(answer), answer.headers
    # A browser of one person may keep what never changes.
    assert "immutable" in tenants.alpha.get(path).headers["cache-control"]


@pytest.mark.parametrize(("method", "path"), sorted(HOUSE))
def test_what_is_of_no_project_is_closed(tenants: Tenants, method: str, path: str) -> None:
    answer = tenants.call(tenants.beta, method, path)
    assert answer.status_code == HOUSE[method, path], answer.text


def test_a_key_of_idempotency_is_of_its_project(tenants: Tenants) -> None:
    headers = {"Idempotency-Key": "one"}
    response = tenants.beta.post("/v1/jobs", json=rods(gamma=(5.0,)), headers=headers)
    assert response.status_code == 202
    assert response.json()["id"] != tenants.parameters["job_id"]
    assert (
        tenants.alpha.post("/v1/jobs", json=rods(name="alpha-s"), headers=headers).status_code
        == 200
    )


def test_an_upload_is_of_its_project(tenants: Tenants) -> None:
    axes = {
        "material": "gray-interlock",
        "mu": 0.3,
        "texture": ["dots", "mine"],
        "viewpoint": "calibrated",
    }
    spec = {"kind": "cloth_drag", "axes": axes, "textures": {"mine": tenants.upload}}
    refused = tenants.beta.post("/v1/jobs:validate", json=spec)
    assert (refused.status_code, "must name a file that was uploaded" in refused.text) == (
        422,
        True,
    ), refused.text
    assert tenants.alpha.post("/v1/jobs:validate", json=spec).status_code == 200


def test_an_admin_sees_every_project(tenants: Tenants) -> None:
    context: Context = tenants.app.state.context
    with context.database.write() as connection:
        secret = create_key(connection, "root", [Scope.admin], time.time())[1]
    tenants.alpha.get("/livez")
    answer = httpx.get(
        str(tenants.alpha.base_url.join(f"/v1/jobs/{tenants.parameters['job_id']}")),
        headers={"Authorization": f"Bearer {secret}"},
        trust_env=False,
    )
    if answer.status_code == 401:  # a new key takes effect within a second
        time.sleep(1.1)
        answer = httpx.get(answer.url, headers=answer.request.headers, trust_env=False)
    assert answer.status_code == 200


def is_over(client: httpx.Client, job: str) -> bool:
    return JobState(client.get(job).json()["state"]) is JobState.succeeded


def test_a_project_does_not_see_the_name_that_another_gave_a_dataset(tenants: Tenants) -> None:
    """Both have specified the same samples: the dataset is shared, and its name is not."""
    context: Context = tenants.app.state.context
    worker = PretendWorker(DirectApi(context), context.store, whole=True).register()
    spec = {"gamma": (17.0, 18.0)}
    names = {tenants.alpha: "alpha-secret", tenants.beta: None}
    datasets_of = {}
    for client, name in names.items():
        job = client.post("/v1/jobs", json=rods(name=name, **spec)).json()["id"]
        worker.work()
        # The coordinator checks a dataset that exists already in the background.
        wait_until(partial(is_over, client, f"/v1/jobs/{job}"))
        datasets_of[client] = client.get(f"/v1/jobs/{job}").json()["dataset"]["dataset"]
    assert datasets_of[tenants.alpha] == datasets_of[tenants.beta]
    path = f"/v1/datasets/{datasets_of[tenants.beta]}"
    assert tenants.alpha.get(path).json()["name"] == "alpha-secret"
    assert tenants.beta.get(path).json()["name"] is None
    files = f"{path}/versions/1/files"
    pages = (path, "/v1/datasets", "/datasets", f"{path.removeprefix('/v1')}/v1")
    for page in (*pages, f"{path}/versions/1/manifest", f"{files}/zarr.json"):
        answer = tenants.beta.get(page)
        assert answer.is_success
        assert "alpha-secret" not in answer.text, page
    tenants.beta.post("/v1/jobs", json=rods(name="beta-s", **spec))
    assert tenants.beta.get(path).json()["name"] == "beta-s"
    assert tenants.alpha.get(path).json()["name"] == "alpha-secret"


def test_only_requests_without_a_project_find_versions_without_a_job(context: Context) -> None:
    """`stickslip reindex` registers versions of a store whose jobs are unknown."""
    with context.database.write() as connection:
        connection.execute(
            insert(datasets).values(id="ds-orphan", name="found", kind="rod", spec_digest="0" * 64)
        )
        connection.execute(
            insert(dataset_versions).values(
                dataset="ds-orphan",
                version=1,
                publish_task=10**6,
                manifest="1" * 64,
                group_digest="2" * 64,
                created_at=0.0,
                sample_count=1,
                valid_count=1,
                bytes=1,
                scrubbed_at=0.0,
                damaged=0,
            )
        )
    everything_but_admin = frozenset(Scope) - {Scope.admin}
    visible_to = {
        "nobody": Principal(scopes=everything_but_admin),
        "project": Principal("key-1 ada", everything_but_admin, "alpha"),
        "administrator": Principal("key-2 bert", frozenset({Scope.admin}), "alpha"),
    }
    visible = {}
    for name, principal in visible_to.items():
        with acting_as(principal), context.database.read() as connection:
            page = list_datasets(connection, PageRequest(10, None))
            visible[name] = [dataset.id for dataset in page.items]
    assert visible == {"nobody": ["ds-orphan"], "project": [], "administrator": ["ds-orphan"]}
