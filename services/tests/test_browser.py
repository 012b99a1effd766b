"""The dashboard in Chromium: every page at two widths, in light and dark, accessible, live, and by
keyboard.

Needs Chromium (`apt-get install chromium`): Playwright brings no browser of its own here.
Accessibility is checked with axe-core, which `axe-playwright-python` brings.
"""

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from stickslip_schemas.documents.certificate import Certificate, CurveReport, ProtocolReport
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.kinds.cloth.spec import GroundTruth
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.scene.library import load_scene
from stickslip_services.app import make_app
from stickslip_services.catalog.inputs import register_certificate
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_sim_core.scenes.cloth_scene import KIND
from stickslip_testing.jobs import parsed, rods, show_job
from stickslip_testing.servers import serving, start_server, wait_until
from stickslip_testing.worker import BUILDS, DirectApi, PretendWorker, rejection

sync_api = pytest.importorskip("playwright.sync_api", reason="make setup-dev")
axe = pytest.importorskip("axe_playwright_python", reason="make setup-dev")

pytestmark = pytest.mark.real

AXE = Path(axe.__file__).with_name("axe.min.js").read_text()

CHROMIUM = Path("/usr/bin/chromium")
if not CHROMIUM.exists():
    pytest.skip("apt-get install chromium", allow_module_level=True)

FLAGS = (
    "--no-sandbox",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return make_app(Settings(data=tmp_path_factory.mktemp("browser"), durable=False))


@pytest.fixture(scope="module")
def url(app: FastAPI) -> Iterator[str]:
    with serving(app) as url:
        yield url


@pytest.fixture(scope="module")
def worker(app: FastAPI, url: str) -> PretendWorker:
    context = app.state.context
    return PretendWorker(
        DirectApi(context),
        context.store,
        kinds=("rod_hang", "cloth_scene"),
        whole=True,
        judge=lambda task: (
            rejection()
            if task.stage == "simulate" and getattr(task.simulation, "gamma", None) == 1.0
            else None
        ),
    ).register()


@pytest.fixture(scope="module")
def paths(app: FastAPI, worker: PretendWorker) -> list[str]:
    """The pages of a service that has made a dataset and is at another."""
    context: Context = app.state.context
    done = submit_job(context, parsed(rods(name="done", gamma=(1.0, 2.0, 3.0))), None)
    worker.work()
    clips = [make_cloth(context, worker, *scene) for scene in SCENES]
    running = submit_job(context, parsed(rods(name="running", gamma=(7.0, 8.0))), None)
    worker.start(*worker.lease(simulate=1))
    assert isinstance(done, JobDetail)
    assert isinstance(running, JobDetail)
    dataset = show_job(context, done.id).dataset
    assert dataset is not None
    root = f"/datasets/{dataset.dataset}/v{dataset.version}"
    jobs = [f"/jobs/{job.id}" for job in (done, running)]
    samples = [f"{root}/samples/{slot}" for slot in (0, 3)]
    uploads = [certificate(extent) for extent in ("full", "quick")]
    entries = [
        register_certificate(context.database, context.store, upload, context.clock())
        for upload in uploads
    ]
    certificates = [f"/certificates/{entry.digest}" for entry in entries]
    addresses = [
        page
        for job, clip in clips
        for page in (job, clip, f"{clip}/samples/1", f"{clip}/samples/0?beside=1")
    ]
    # Samples of two datasets whose motions differ in number and rate.
    places = [clip.removeprefix("/datasets/").replace("/v", ":v") for _, clip in clips]
    compared = f"{clips[0][1]}/samples/0?beside=1&of={places[1]}"
    return [
        "/",
        *jobs,
        "/datasets",
        root,
        *samples,
        "/certificates",
        *certificates,
        "/workers",
        "/docs",
        *addresses,
        f"{jobs[0]}/tasks/{worker.finished_ids[0]}",
        "/submit",
        "/submit?kind=cloth_drag",
        "/scenes",
        f"/scenes/{load_scene('belt').digest}",
        compared,
        f"/submit?job={clips[0][0].rpartition('/')[2]}",
    ]


SCENES = (
    (
        "turning-ball",
        {"duration": 1.0, "sheets.napkin.mesh.cells": [6, 6], "bodies.ball.motion.spin.begin": 0.0},
    ),
    ("over-the-edge", {"duration": 1.0, "sheets.strip.mesh.cells": [40, 4]}),
)
"""Small scenes: one with a floor and a ball, one with a table and a holder, but without a floor."""


def make_cloth(
    context: Context, worker: PretendWorker, scene: str, values: dict[str, Any]
) -> tuple[str, str]:
    """Make a dataset of true motions and invented pictures.

    Return the pages of the job and of the dataset.
    """
    spec = parsed(
        {
            "kind": "cloth_scene",
            "name": scene,
            "scene": scene,
            "set": values,
            "axes": {"mu": [0.2, 0.5], "texture": "dots", "viewpoint": "front"},
            "frames": 5,
            "ground_truth": list(GroundTruth),
            "allow_uncertified": True,
            "samples_per_shard": 2,
        }
    )
    (outcome,) = KIND.simulate(
        [{"scene": with_arrays(spec.stage, context.store.read), "seed": 1}], None
    )
    assert not outcome.reason
    worker.record = outcome.record
    submitted = submit_job(context, spec, None)
    assert isinstance(submitted, JobDetail)
    worker.work()
    worker.record = {}
    dataset = show_job(context, submitted.id).dataset
    assert dataset is not None
    return f"/jobs/{submitted.id}", f"/datasets/{dataset.dataset}/v{dataset.version}"


def certificate(extent: Literal["full", "quick"]) -> Certificate:
    x = tuple(np.geomspace(1, 100, 200).tolist())
    curve = CurveReport(
        parameters={"mesh": 0.0},
        x=(1.0, 10.0, 100.0),
        measured=(1.001, 10.0, None),
        master=(1.0, 10.0, None),
        errors=(0.001, 0.0, 0.0),
        dense_x=x,
        dense_master=x,
    )
    report = ProtocolReport(
        protocol="cantilever",
        x="Gamma",
        y="H/W",
        tolerance=0.01,
        error=0.001,
        passed=True,
        settings={},
        build_hash="1" * 64,
        curves=(curve,),
    )
    return Certificate(
        preset="certified",
        numbers={},
        sim_core=BUILDS.sim_core,
        protocol_sources="2" * 64,
        extent=extent,
        protocols=(report,),
        passed=True,
        environment={"cores": "2"},
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=list(FLAGS))
        yield browser
        browser.close()


SCHEMES = {1280: {"light": "{}", "dark": "{runOnly: ['color-contrast']}"}, 390: {"dark": "{}"}}
"""By width, the colour schemes and what axe looks at."""


@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.slow)])
def test_every_page_is_whole(browser: Any, url: str, paths: list[str], width: int) -> None:
    context = browser.new_context(viewport={"width": width, "height": 900}, reduced_motion="reduce")
    page = context.new_page()
    faults: list[str] = []
    page.on(
        "console", lambda message: faults.append(message.text) if message.type == "error" else None
    )
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on(
        "request",
        lambda request: (
            None
            if request.url.startswith((url, "data:", f"blob:{url}"))
            else faults.append(request.url)
        ),
    )
    for path in paths:
        page.goto(url + path)
        page.wait_for_load_state("load")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (
            f"{path} is wider than {width} px"
        )
        assert page.locator("h1").count() == 1
        if path.startswith("/v1/"):
            continue  # inert: its policy lets no script run, axe neither
        page.evaluate(AXE)
        for scheme, options in SCHEMES[width].items():
            page.emulate_media(color_scheme=scheme)
            violations = page.evaluate(f"axe.run({options})")["violations"]
            broken_rules = [(v["id"], v["impact"], v["nodes"][0]["html"]) for v in violations]
            assert broken_rules == [], (path, scheme)
    assert faults == []
    context.close()


def test_a_page_follows_the_job_and_its_buttons_work(
    browser: Any, url: str, paths: list[str], app: FastAPI, worker: PretendWorker
) -> None:
    page = browser.new_page()
    page.goto(url + paths[2])
    page.get_by_role("button", name="Pause").click()
    wait_until(lambda: "paus" in page.locator(".state").first.inner_text())
    page.get_by_role("button", name="Resume").click()
    wait_until(lambda: page.locator(".state").first.inner_text() == "running")
    before = page.locator("progress").first.get_attribute("value")
    worker.finish(*worker.lease(simulate=2))
    wait_until(
        lambda: page.locator("progress").first.get_attribute("value") != before
    )  # nobody reloaded
    page.close()


def test_the_keyboard_is_enough(browser: Any, url: str, paths: list[str]) -> None:
    page = browser.new_page()
    page.goto(url + paths[4])
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"
    page.locator("input[name='gamma.from']").focus()
    page.keyboard.press("End")
    wait_until(lambda: page.locator("#thumbs p").first.inner_text().startswith("2 of 6"))
    wait_until(lambda: "gamma.from=2" in page.url)
    page.reload()  # the filters are in the address
    assert page.locator("#thumbs p").first.inner_text().startswith("2 of 6")
    assert page.locator("input[name='gamma.from']").input_value() == "2"
    page.close()


def test_a_sample_in_space_turns_and_follows_the_cursor(
    browser: Any, url: str, paths: list[str]
) -> None:
    page = browser.new_page()
    page.goto(url + next(path for path in paths if path.endswith("/samples/1")))
    canvas = page.locator(".space canvas")
    page.get_by_role("button", name="Show it in three dimensions").click()
    page.locator(".space[data-drawn]").wait_for()
    pictures = [canvas.screenshot()]
    canvas.focus()
    page.keyboard.press("Shift+ArrowRight")
    pictures.append(canvas.screenshot())
    page.locator(".time").focus()
    page.keyboard.press("End")
    pictures.append(canvas.screenshot())
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 50, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"] + 80)
    page.mouse.up()
    pictures.append(canvas.screenshot())
    page.emulate_media(color_scheme="dark")
    pictures.append(canvas.screenshot())
    assert len(set(pictures)) == len(pictures)
    assert "Cells of the floor" in page.locator(".space .scale").inner_text()
    page.close()


def test_two_samples_share_the_cursor_and_the_layer(
    browser: Any, url: str, paths: list[str]
) -> None:
    page = browser.new_page()
    page.goto(url + next(path for path in paths if path.endswith("?beside=1")))
    page.locator(".layer").select_option("depth")
    page.locator(".time").focus()
    page.keyboard.press("End")
    # Both clips are at the middle of their last frame, and have one scale.
    times = "[...document.querySelectorAll('video')].map((video) => video.currentTime)"
    wait_until(lambda: page.evaluate(times) == pytest.approx([0.45, 0.45]))
    links = [link.get_attribute("href") for link in page.locator(".mp4").all()]
    assert [link.rpartition("samples")[2] for link in links] == [
        "/0/depth.mp4?beside=1",
        "/1/depth.mp4?beside=0",
    ]
    headings = page.locator(".clip h2").all_inner_texts()
    assert [heading.split("mu")[0].strip() for heading in headings] == ["Sample 0", "Sample 1"]
    legend = page.locator(".plots .u-legend").first.inner_text()
    assert "sample 0: " in legend
    assert "sample 1: " in legend
    for number in (0, 1):
        page.get_by_role("button", name=f"Show sample {number} in three dimensions").click()
    page.locator(".space[data-drawn]").nth(1).wait_for()
    page.close()


def test_a_sample_without_webgl_says_so(browser: Any, url: str, paths: list[str]) -> None:
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(url + paths[6])
    page.get_by_role("button", name="Show it in three dimensions").click()
    wait_until(lambda: "has no WebGL" in page.locator(".space .message").inner_text())
    assert page.locator(".space canvas").count() == 0
    page.close()


LEAST_BYTES = 300_000
"""Most bytes that the page of a sample of cloth loads before somebody asks for more."""


def test_a_sample_of_cloth_is_light_and_plays(browser: Any, url: str, paths: list[str]) -> None:
    page = browser.new_page()
    sizes: list[int] = []
    page.on("response", lambda response: sizes.append(len(response.body())))
    page.goto(url + next(path for path in paths if path.endswith("/samples/1")))
    page.wait_for_load_state("networkidle")
    assert 10_000 < sum(sizes) <= LEAST_BYTES
    time_of = "document.querySelector('video').currentTime"
    wait_until(lambda: page.evaluate(time_of) == pytest.approx(0.05))
    page.get_by_role("button", name="One frame on").press("Enter")
    wait_until(lambda: page.evaluate(time_of) == pytest.approx(0.15))
    page.get_by_role("button", name="One frame back").press("Enter")
    wait_until(lambda: page.evaluate(time_of) == pytest.approx(0.05))
    page.locator(".speed").select_option("0.25")
    page.get_by_role("button", name="Play").press("Enter")
    wait_until(lambda: page.evaluate(time_of) > 0.1)
    page.get_by_role("button", name="Stop").press("Enter")
    assert re.fullmatch(r"\d\.\d\d of \d\.\d\d s", page.locator(".controls output").inner_text())
    page.close()


def test_a_sample_without_mp4_shows_its_frames(browser: Any, url: str, paths: list[str]) -> None:
    page = browser.new_page()
    page.route("**/*.mp4", lambda route: route.fulfill(status=404))
    page.goto(url + next(path for path in paths if path.endswith("/samples/1")))
    page.locator(".time").focus()
    page.keyboard.press("End")
    picture = page.locator(".clip > img.screen")
    wait_until(lambda: (picture.get_attribute("src") or "").endswith("/video/4.png"))
    assert picture.is_visible()
    page.close()


AWAY_SECONDS = 5.0
"""Time after which a page must say that the service is away [s]."""


def test_a_page_says_that_the_service_is_away_and_recovers(browser: Any, tmp_path: Path) -> None:
    server = start_server(tmp_path / "data")
    job = httpx.post(f"{server.url}/v1/jobs", json=rods()).json()["id"]
    page = browser.new_page()
    page.goto(f"{server.url}/jobs/{job}")
    page.get_by_role("button", name="Pause").wait_for()
    assert page.locator("#away").is_hidden()
    port = int(server.url.rpartition(":")[2])
    server.process.kill()
    server.stop()
    killed_at = time.monotonic()
    page.locator("#away").wait_for(timeout=1000 * AWAY_SECONDS)
    assert time.monotonic() - killed_at < AWAY_SECONDS
    assert "The service is away since" in page.locator("#away").inner_text()
    # A press meanwhile is not lost in silence, and can be repeated.
    page.get_by_role("button", name="Pause").click()
    page.locator("#lost").get_by_text(
        "“Pause” had no effect: the service did not answer"
    ).wait_for()
    server = start_server(tmp_path / "data", port)
    try:
        page.locator("#away").wait_for(state="hidden", timeout=20_000)
        page.locator("#lost").get_by_role("button", name="Try again").click()
        page.get_by_role("button", name="Resume").wait_for()
        assert page.locator(".state").first.inner_text() == "paused"
        assert page.locator("#lost").inner_text() == ""
    finally:
        page.close()
        server.stop()


def test_a_refused_press_is_explained(
    browser: Any, url: str, paths: list[str], app: FastAPI
) -> None:
    job = submit_job(app.state.context, parsed(rods(name="raced", gamma=(21.0,))), None)
    assert isinstance(job, JobDetail)
    page = browser.new_page()
    # As of a page that is not told of changes.
    page.route("**/ui/changes", lambda route: route.abort())
    page.goto(f"{url}/jobs/{job.id}")
    cancel_job(app.state.context, job.id)
    page.get_by_role("button", name="Pause").click()
    page.locator("#lost").get_by_text("“Pause” had no effect: job").wait_for()
    assert "can be paused" in page.locator("#lost").inner_text()
    page.close()


def test_a_form_that_did_not_arrive_is_offered_again(
    browser: Any, url: str, worker: PretendWorker
) -> None:
    assert worker.id
    page = browser.new_page()
    page.goto(f"{url}/submit?kind=rod_hang")
    for axis in ("gamma", "phi0", "phi1"):
        page.locator(f"[name='axes.{axis}.values']").fill("4.5")
    page.route("**/ui/submit", lambda route: route.abort())
    page.get_by_role("button", name="Submit the job").press("Enter")
    notice = page.locator("#lost").get_by_text("“Submit the job” had no effect")
    notice.wait_for()
    page.unroute("**/ui/submit")
    page.get_by_role("button", name="Try again").press("Enter")
    page.wait_for_url("**/jobs/job-*")
    # A check that is refused, as with a key that may only read, gives the reason.
    refusal = '{"detail": "the request needs the scope submit"}'
    page.route("**/ui/submit/check", lambda route: route.fulfill(status=403, body=refusal))
    page.goto(f"{url}/submit?kind=rod_hang")
    page.locator("#lost").get_by_text("the request needs the scope submit").wait_for()
    page.close()


MAX_TABS = 300
"""Presses of Tab after which a test gives up."""

IS_FOCUSED = """wanted => {
    const focused = document.activeElement;
    const names = [focused.name, focused.id, focused.textContent, focused.ariaLabel];
    return names.some((name) => (name || "").trim() === wanted);
}"""


def tab_to(page: Any, wanted: str) -> None:
    """Press Tab until the focus is on the element of a name, an id, a text or a label."""
    for _ in range(MAX_TABS):
        if page.evaluate(IS_FOCUSED, wanted):
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"Tab does not lead to {wanted!r}")


def test_a_grid_is_submitted_filtered_and_downloaded_by_keyboard(
    browser: Any, url: str, worker: PretendWorker
) -> None:
    page = browser.new_page()
    page.goto(url)
    tab_to(page, "Submit")
    page.keyboard.press("Enter")
    page.locator("#scene").wait_for()
    tab_to(page, "scene")
    page.keyboard.type("turning")
    tab_to(page, "Show its form")
    page.keyboard.press("Enter")
    page.wait_for_url("**scene=turning-ball*")
    for field, text in (
        ("name", "by-keyboard"),
        ("axes.mu.form", "evenly"),
        ("axes.mu.from", "0.1"),
        ("axes.mu.to", "0.9"),
        ("axes.mu.num", "10"),
        ("frames", "5"),
    ):
        tab_to(page, field)
        page.keyboard.type(text)
    tab_to(page, "allow_uncertified")
    page.keyboard.press("Space")
    # The size and the cost stand there before the job does.
    check = page.locator("#check")
    wait_until(
        lambda: "samples\n10" in check.inner_text() and "certificate" not in check.inner_text()
    )
    assert "CPU time" in check.inner_text()
    tab_to(page, "Submit the job")
    page.keyboard.press("Enter")
    page.wait_for_url("**/jobs/job-*")
    worker.work()
    page.locator(".state.succeeded").wait_for()
    tab_to(page, "Download files")
    page.keyboard.press("Enter")
    page.wait_for_url("**/datasets/ds-*/v1*")
    for number, operator, value in ((0, "<", "0.5"), (1, ">", "0.15")):
        tab_to(page, f"where{number}.label")
        page.keyboard.type("mu")
        tab_to(page, f"where{number}.operator")
        page.keyboard.type(operator)
        tab_to(page, f"where{number}.value")
        page.keyboard.type(value)
    page.keyboard.press("Enter")
    wait_until(lambda: page.locator("#thumbs p").first.inner_text().startswith("4 of 10 samples"))
    with page.expect_download() as zipped:
        tab_to(page, "Download these as zip")
        page.keyboard.press("Enter")
    assert zipped.value.suggested_filename == "by-keyboard-v1.zip"
    page.locator(".thumbs a").first.focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**/samples/1")
    tab_to(page, "Play")
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Stop").wait_for()
    with page.expect_download() as shard:
        tab_to(page, "Download the shard video/c/0/0/0/0/0")
        page.keyboard.press("Enter")
    assert shard.value.suggested_filename == "video-c-0-0-0-0-0"
    page.close()
