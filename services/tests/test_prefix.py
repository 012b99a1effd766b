"""The service below a path: links, answers and refusals with a prefix, and pages behind nginx."""

import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlencode

import httpx
import pytest
from stickslip_services.addresses import OWN_WORDS, checked_prefix, without_prefix
from stickslip_services.app import make_app
from stickslip_services.errors import SettingsError
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.nginx import nginx
from stickslip_testing.servers import RunningServer, serving
from stickslip_testing.worker import DirectApi, PretendWorker


@pytest.mark.parametrize(
    "wrong",
    ["stickslip", "//evil.example", "/a/../b", "/a b", "/x\n", "/<script>", "/v1", "/datasets/lab"],
)
def test_a_wrong_prefix_is_refused(wrong: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must"):
        checked_prefix(wrong)
    with pytest.raises(SettingsError, match="root_path must"):
        Settings.chosen(data=tmp_path, root_path=wrong)


def test_prefixes_are_taken_off_once() -> None:
    assert checked_prefix("/lab/stickslip/") == "/lab/stickslip"
    assert checked_prefix("/") == checked_prefix("") == ""
    assert without_prefix("/lab/v1/jobs", "/lab") == "/v1/jobs"
    assert without_prefix("/lab", "/lab") == "/"
    assert without_prefix("/laboratory", "/lab") == "/laboratory"
    assert without_prefix("/v1/jobs", "/lab") == "/v1/jobs"


def test_no_prefix_can_hide_a_path_of_the_coordinator(tmp_path: Path) -> None:
    app = make_app(Settings(data=tmp_path, durable=False))
    routes = [*app.state.routes, *app.routes]
    words = {route.path.split("/")[1] for route in routes if route.path != "/"}
    assert words - set(OWN_WORDS) == set()


def addresses_of(page: str) -> set[str]:
    """Return the addresses that a page loads, follows or sends to, but for anchors."""
    matches = re.findall(
        r'(?:src|href|action|hx-get|hx-post|data-root|data-motion)="([^"#]+)', page
    )
    return {address for address in matches if not address.startswith("data:")}


@pytest.mark.parametrize("is_stripped", [True, False])
def test_pages_and_answers_begin_with_the_prefix(tmp_path: Path, is_stripped: bool) -> None:
    app = make_app(Settings(data=tmp_path, durable=False))
    headers = {"X-Forwarded-Prefix": "/lab", "X-Forwarded-Proto": "https"}
    with serving(app) as url, httpx.Client(headers=headers, timeout=20) as client:
        context = app.state.context
        worker = PretendWorker(DirectApi(context), context.store, whole=True).register()
        base = url if is_stripped else f"{url}/lab"
        submitted = client.post(f"{base}/v1/jobs", json=rods())
        assert submitted.headers["location"] == f"/lab/v1/jobs/{submitted.json()['id']}"
        worker.work()
        job = f"/jobs/{submitted.json()['id']}"
        ended = client.get(f"{base}/v1{job}").json()["dataset"]
        version = f"/datasets/{ended['dataset']}/v1"
        moved = client.get(f"{base}/datasets/{ended['dataset']}")
        assert moved.headers["location"] == f"/lab{version}"
        assert client.get(f"{base}/v1{job}/previews").json()[0]["href"].startswith("/lab/v1/")
        pages = ["/", job, "/datasets", version, f"{version}/samples/0", "/scenes", "/workers"]
        for path in [*pages, "/certificates", "/docs"]:
            page = client.get(base + path).text
            wrong = {
                address
                for address in addresses_of(page)
                if not address.startswith(("/lab/", "https://")) and address != "/lab"
            }
            assert wrong == set(), path
            assert not re.search(r'"/(ui|static|v1|jobs|datasets)/', page), path
        # Commands that a page shows name the address that the browser uses.
        port = url.rpartition(":")[2]
        assert f"--url https://127.0.0.1:{port}/lab" in client.get(base + version).text


def test_a_wrong_header_is_refused_with_the_reason(tmp_path: Path) -> None:
    with serving(make_app(Settings(data=tmp_path, durable=False))) as url:
        answer = httpx.get(url, headers={"X-Forwarded-Prefix": "//evil.example"})
        assert answer.status_code == 400
        assert "X-Forwarded-Prefix must be a path such as /stickslip" in answer.json()["detail"]


def test_a_prefix_opens_nothing_without_a_key(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, durable=False, require_keys=True, root_path="/lab")
    with serving(make_app(settings)) as url:
        for path in ("/lab/v1/jobs", "/v1/jobs", "/lab/", "/lab/lab/v1/jobs"):
            assert httpx.get(url + path).status_code == 401
        headers = {"X-Forwarded-Prefix": "/livez"}
        assert httpx.get(f"{url}/livez/v1/jobs", headers=headers).status_code == 400
        assert httpx.get(f"{url}/lab/livez").status_code == 200


@pytest.fixture
def behind_nginx(tmp_path: Path) -> Iterator[tuple[str, RunningServer]]:
    """The address of a service below /stickslip/ of nginx, and the service."""
    with serving(make_app(Settings(data=tmp_path / "data", durable=False))) as service:
        # The slash at the end of the service's address makes nginx strip the prefix.
        location = f"""
            location /stickslip/ {{
              proxy_pass {service}/;
              proxy_http_version 1.1;
              proxy_set_header Host $http_host;
              proxy_set_header X-Forwarded-Prefix /stickslip;
              proxy_buffering off;
            }}
        """
        with nginx(tmp_path, server=location) as address:
            yield f"{address}/stickslip", RunningServer(service, tmp_path / "data")


@pytest.mark.real
def test_the_service_works_behind_nginx(behind_nginx: tuple[str, RunningServer]) -> None:
    address, running = behind_nginx
    submitted = httpx.post(f"{address}/v1/jobs", json=rods())
    job = submitted.json()["id"]
    assert submitted.headers["location"] == f"/stickslip/v1/jobs/{job}"
    page = httpx.get(f"{address}/jobs/{job}").text
    for path in sorted(addresses_of(page)):
        if path.startswith("/stickslip/ui/") and "/map" not in path and "/slowest" not in path:
            continue  # buttons
        followed = httpx.get(address.removesuffix("/stickslip") + path, follow_redirects=True)
        assert followed.status_code == 200, path
    # The form, from its page to the job.
    worker = running.worker(whole=True)
    origin = address.removesuffix("/stickslip")
    form = httpx.get(f"{address}/submit?kind=rod_hang").text
    assert 'hx-post="/stickslip/ui/submit"' in form
    fields = {"kind": "rod_hang", "axes.gamma.values": "3", "axes.phi0.values": "0"}
    headers = {"Origin": origin, "Content-Type": "application/x-www-form-urlencoded"}
    body = urlencode(fields | {"axes.phi1.values": "1, 2"})
    response = httpx.post(f"{address}/ui/submit", content=body, headers=headers)
    assert response.headers["hx-redirect"].startswith("/stickslip/jobs/job-")
    worker.work()
    # Downloads: a shard that the page of the dataset links to, and samples as a zip file.
    (dataset, *_) = httpx.get(f"{address}/v1/datasets").json()["items"]
    page = httpx.get(f"{address}/datasets/{dataset['id']}/v1").text
    shard = re.search(r'href="(/stickslip/v1/[^"]*/files/views/c/0[^"]*)"', page)
    assert shard is not None
    assert len(httpx.get(origin + shard[1]).content) > 1000
    zipped = httpx.get(f"{address}/ui/datasets/{dataset['id']}/v1/selection.zip")
    assert zipped.content.startswith(b"PK")
    # A press of a button, with the Origin that a browser sends.
    job = httpx.post(f"{address}/v1/jobs", json=rods(gamma=(9.0,))).json()["id"]
    paused = httpx.post(f"{address}/ui/jobs/{job}/pause", headers={"Origin": origin})
    assert paused.headers["hx-redirect"] == f"/stickslip/jobs/{job}"
    with httpx.stream("GET", f"{address}/ui/changes") as stream:
        lines = stream.iter_lines()
        assert any(line == "event: change" for line in lines)
