"""The page of a dataset: what it says of losses, and that its maps put them where they were."""

import re
from collections import Counter
from typing import Any

import pytest
from stickslip_schemas.base.states import Reason
from stickslip_schemas.format.manifest import Contents, Manifest, Rejection
from stickslip_schemas.plan.grid import dataset_id
from stickslip_services.app import make_app
from stickslip_services.pages.dataset_page import LISTED, dataset_page
from stickslip_services.settings import Settings
from stickslip_testing.jobs import parsed, rods
from stickslip_testing.samples import samples
from stickslip_testing.servers import serving
from stickslip_testing.worker import BUILDS, DirectApi, PretendWorker, rejection


def manifest(spec: dict[str, Any], lose: Any = lambda _labels: False, message: str = "made up") -> Manifest:
    job = parsed(spec)
    members = list(samples(job, BUILDS))
    rejections = tuple(
        Rejection(
            slot=sample.slot,
            sample_key=sample.key,
            reason=Reason.out_of_frame,
            message=message,
            labels=sample.labels,
        )
        for sample in members
        if lose(sample.labels)
    )
    return Manifest(
        dataset=dataset_id(job),
        version=1,
        spec=job,
        spec_digest=job.content_digest,
        builds=BUILDS,
        cameras=(),
        sample_count=len(members),
        valid_count=len(members) - len(rejections),
        split_counts={"train": len(members) - len(rejections)},
        rejection_counts=Counter(str(item.reason) for item in rejections),
        rejections=rejections,
        sample_keys=tuple(sample.key for sample in members),
        files=(),
    )


def grid_spec(gammas: int = 30) -> dict[str, Any]:
    spec = rods(gamma={"type": "linspace", "start": 100, "stop": 1300, "num": gammas}, phi1=(6.0, 10.0, 20.0))
    spec["axes"]["phi0"] = [0.2, 12.0]
    return spec


def contents_of(*arguments: Any, **options: Any) -> Contents:
    """Return what a made-up manifest lists."""
    return Contents(manifest(*arguments, **options), lambda _: b"")


def cells(page: str, name: str) -> list[tuple[int, str]]:
    """Return how many were lost in each cell of a map, and what the cell says."""
    (drawing,) = re.findall(rf'<svg role="img" aria-label="lost over {name}".*?</svg>', page, re.DOTALL)
    return [
        (int(count), told) for count, told in re.findall(r'data-lost="(\d+)"><title>(.*?)</title>', drawing, re.DOTALL)
    ]


def test_nothing_lost_is_said() -> None:
    page = dataset_page(contents_of(grid_spec()))
    assert "<b>100.00%</b> accepted: 180 of" in page
    assert "No sample was rejected." in page
    assert "No region has lost a sample" in page
    assert "The rejected samples" not in page
    assert {count for count, _ in cells(page, "gamma and phi0")} == {0}


def test_maps_put_losses_where_they_were() -> None:
    page = dataset_page(contents_of(grid_spec(), lambda at: at["gamma"] < 200 and at["phi1"] > 15))
    assert "<b>96.67%</b> accepted: 174 of" in page
    assert re.search(r"<td>out_of_frame</td><td>6</td><td>3.33%</td>", page)
    # 100 to 200 is the first of 12 cells of gamma: 3 weights, 2 twists, 1 of 3 curvatures.
    assert [told for count, told in cells(page, "gamma and phi1") if count] == [
        "gamma 100 to 200, phi1 20: 6 of 6 lost"
    ]
    assert [told for count, told in cells(page, "gamma and phi0") if count] == [
        "gamma 100 to 200, phi0 0.2: 3 of 9 lost",
        "gamma 100 to 200, phi0 12: 3 of 9 lost",
    ]
    assert [count for count, _ in cells(page, "phi0 and phi1")] == [0, 0, 3, 0, 0, 3]
    assert sum(count for count, _ in cells(page, "gamma and phi0")) == 6


def test_zipped_and_random_axes_are_mapped_where_there_are_samples() -> None:
    spec = rods(gamma={"type": "random", "low": 100.0, "high": 1300.0, "num": 40, "seed": 3}, combine="zip")
    spec["axes"] |= {
        "phi0": {"type": "random", "low": 0.2, "high": 12.0, "num": 40, "seed": 3},
        "phi1": {"type": "random", "low": 6.0, "high": 20.0, "num": 40, "seed": 3},
    }
    page = dataset_page(contents_of(spec, lambda at: at["gamma"] > 900))
    told = cells(page, "gamma and phi0")
    asked = [int(count) for _, text in told for count in re.findall(r"of (\d+) lost", text)]
    assert sum(asked) == 40
    assert 0 < sum(count for count, _ in told) < 40


def test_one_axis_has_no_map() -> None:
    spec = rods(gamma=(1.0, 2.0), phi1=3.0)
    page = dataset_page(contents_of(spec))
    assert "fewer than two axes" in page
    assert "<svg" not in page


def test_what_comes_from_elsewhere_is_escaped_and_long_lists_end() -> None:
    page = dataset_page(contents_of(grid_spec(100), lambda at: at["phi1"] > 15, message="<script>"))
    assert "<script>" not in page
    assert page.count("&lt;script&gt;") == LISTED
    assert ">0 more are" not in page
    page = dataset_page(contents_of(grid_spec(101), lambda at: at["phi1"] > 15))
    assert "2 more are in the manifest" in page


@pytest.fixture
def settings(tmp_path: Any) -> Settings:
    return Settings(data=tmp_path / "data", durable=False)


def test_the_coordinator_serves_it(settings: Settings) -> None:
    import httpx

    app = make_app(settings)

    def judge(task: Any) -> Any:
        return rejection() if task.stage == "simulate" and task.simulation.gamma > 1.5 else None

    with serving(app) as url, httpx.Client(base_url=url) as client:
        worker = PretendWorker(DirectApi(app.state.context), app.state.context.store, judge=judge).register()
        job = client.post("/v1/jobs", json=rods()).json()["id"]
        worker.work()
        dataset = client.get(f"/v1/jobs/{job}").json()["dataset"]["dataset"]
        answer = client.get(f"/v1/datasets/{dataset}/versions/1/page")
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/html")
        assert "sandbox" in answer.headers["content-security-policy"]
        assert "<b>50.00%</b> accepted" in answer.text
        assert "it diverged" in answer.text
        assert client.get(f"/v1/datasets/{dataset}/versions/2/page").status_code == 404
