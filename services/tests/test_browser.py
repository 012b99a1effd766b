"""The dashboard in Chromium: every page at two widths, live updates, buttons and the keyboard.

Needs Chromium (`apt-get install chromium`) and Playwright (`pip install playwright`; it brings no browser of its own
here). With `STICKSLIP_AXE` naming axe-core's `axe.min.js`, accessibility is checked, too.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from stickslip_services.coordinator import make_app
from stickslip_services.settings import Settings
from stickslip_services.testing import PretendWorker, parsed, rejection, rods, serving, wait_until

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")

CHROMIUM = Path("/usr/bin/chromium")
if not CHROMIUM.exists():
    pytest.skip("apt-get install chromium", allow_module_level=True)

FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
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
    coordinator = app.state.coordinator
    return PretendWorker(
        coordinator,
        coordinator.store,
        whole=True,
        judge=lambda task: rejection() if task.stage == "simulate" and task.simulation.gamma == 1.0 else None,
    ).register()


@pytest.fixture(scope="module")
def paths(app: FastAPI, worker: PretendWorker) -> list[str]:
    """The pages of a service that has made a dataset and is at another."""
    coordinator = app.state.coordinator
    done = coordinator.submit(parsed(rods(name="done", gamma=(1.0, 2.0, 3.0))), None)
    worker.work()
    running = coordinator.submit(parsed(rods(name="running", gamma=(7.0, 8.0))), None)
    worker.start(*worker.lease(simulate=1))
    with coordinator.database.read() as connection:
        dataset = coordinator.show(connection, 1).dataset
    root = f"/datasets/{dataset.dataset}/v{dataset.version}"
    jobs = [f"/jobs/{job.id}" for job in (done, running)]
    samples = [f"{root}/samples/{slot}" for slot in (0, 3)]
    return ["/", *jobs, "/datasets", root, *samples, "/certificates", "/workers", "/docs"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=list(FLAGS))
        yield browser
        browser.close()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_every_page_is_whole(browser: Any, url: str, paths: list[str], width: int, scheme: str) -> None:
    axe = Path(os.environ.get("STICKSLIP_AXE", "/nonexistent"))
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=axe.exists()
    )
    page = context.new_page()
    faults: list[str] = []
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    for path in paths:
        page.goto(url + path)
        page.wait_for_load_state("load")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{path} is wider than {width} px"
        assert page.locator("h1").count() == 1
        assert page.evaluate("[...document.images].every((image) => image.alt !== null)")
        if axe.exists():
            page.evaluate(axe.read_text())
            violations = page.evaluate("axe.run()")["violations"]
            assert [v["id"] for v in violations if v["impact"] in ("serious", "critical")] == [], path
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
    wait_until(lambda: page.locator("progress").first.get_attribute("value") != before)  # nobody reloaded
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
    page.close()


def test_a_shape_is_drawn_and_turns(browser: Any, url: str, paths: list[str]) -> None:
    page = browser.new_page()
    page.goto(url + paths[6])
    pixels = "document.querySelector('canvas').getContext('2d').getImageData(0, 0, 560, 420).data"
    ink = f"[...{pixels}].reduce((a, b) => a + b)"
    wait_until(lambda: page.evaluate(ink) > 0)
    before = page.evaluate("document.querySelector('canvas').toDataURL()")
    page.locator("canvas").focus()
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.querySelector('canvas').toDataURL()") != before
    page.close()
