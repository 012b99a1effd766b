"""Versions whose manifest has sections: served, pulled, checked, compared, found again and
collected like others.
"""

import json
import random
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from stickslip_schemas.base import JobState, Reason, sha256
from stickslip_schemas.format.manifest import MANIFEST_NAME, SEALED_NAMES, Contents, Manifest
from stickslip_schemas.format.selection import Selection
from stickslip_services.app import make_app
from stickslip_services.client.errors import ForeignFilesError
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import pull
from stickslip_services.client.verifying import verify
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.maintenance import reindex, unused
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, list_datasets, parsed, rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker, rejection

GAMMAS = (1.0, 2.0, 3.0, 4.0)
"""With two phi1 and two slots to a shard: slots 0 to 7, and a section for each two of them."""
SECTIONS = [f"manifest/{number}.json" for number in range(4)]


@pytest.fixture(autouse=True)
def small_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stickslip_schemas.format.manifest.SECTION_SAMPLES", 3)


@pytest.fixture
def application(settings: Settings) -> FastAPI:
    """A coordinator; its worker rejects the sample in slot 5."""
    return make_app(settings)


@pytest.fixture
def origin(application: FastAPI) -> Iterator[tuple[str, str, PretendWorker]]:
    """URL, dataset and worker of a coordinator that has made a version with four sections."""
    with serving(application) as url, Client(url) as client:
        context: Context = application.state.context
        worker = PretendWorker(DirectApi(context), context.store, whole=True).register()
        worker.judge = lambda task: (
            rejection()
            if task.stage == "simulate"
            and (task.simulation.gamma, task.simulation.phi1) == (3.0, 3.0)
            else None
        )
        job = client.submit(rods(gamma=GAMMAS))
        worker.work()
        detail = client.job(job.id)
        assert (detail.state, detail.rejected_count) == (JobState.succeeded_with_rejects, 1), (
            detail.message
        )
        assert detail.dataset is not None
        yield url, detail.dataset.dataset, worker


def files(target: Path) -> set[str]:
    return {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()}


def test_a_pull_brings_the_sections_and_a_second_one_nothing(
    origin: tuple[str, str, PretendWorker], tmp_path: Path
) -> None:
    url, dataset, _ = origin
    with Client(url) as client:
        first = pull(client, dataset, 1, tmp_path / "d")
        assert set(SECTIONS) < files(tmp_path / "d")
        assert first.files == first.downloaded_files == len(files(tmp_path / "d"))
        assert pull(client, dataset, 1, tmp_path / "d").downloaded_files == 0
        assert verify(tmp_path / "d") == []
        contents = client.contents(dataset, 1)
        assert {file.path for file in contents.files()} | set(SEALED_NAMES) == files(tmp_path / "d")
        (lost,) = contents.rejections()
        assert (lost.slot, contents.manifest.rejection_counts) == (5, {"solver_diverged": 1})
        other = tmp_path / "other/views/c/9"
        other.mkdir(parents=True)
        (other / "0").write_text("mine")
        with pytest.raises(ForeignFilesError, match="views/c/9/0"):
            pull(client, dataset, 1, tmp_path / "other")
        keys = list(contents.sample_keys())

        assert list(client.contents(dataset, 1).sample_keys()) == keys


def test_files_and_pages_of_sections_are_served(origin: tuple[str, str, PretendWorker]) -> None:
    url, dataset, _ = origin
    root = f"/v1/datasets/{dataset}/versions/1"
    with httpx.Client(base_url=url, trust_env=False) as client:
        manifest = Manifest.model_validate_json(client.get(f"{root}/manifest").content)
        assert [file.path for file in manifest.sections] == SECTIONS
        for entry in manifest.sections:
            content = client.get(f"{root}/files/{entry.path}").content
            assert (sha256(content), len(content)) == (entry.sha256, entry.size)
            for file in json.loads(content)["files"]:
                assert sha256(client.get(f"{root}/files/{file['path']}").content) == file["sha256"]
        assert client.get(f"{root}/files/views/c/4/0/0/0/0").status_code == 404
        assert client.get(f"{root}/files/manifest/4.json").status_code == 404
        assert "it diverged" in client.get(f"/datasets/{dataset}/v1").text
        assert "it diverged" in client.get(f"/datasets/{dataset}/v1/samples/5").text
        assert client.get(f"/datasets/{dataset}/v1/samples/7").status_code == 200


def test_a_part_needs_only_the_sections_of_its_samples(
    origin: tuple[str, str, PretendWorker], tmp_path: Path
) -> None:
    url, dataset, _ = origin
    target = tmp_path / "part"
    chosen = Selection(
        arrays=("views",), where=("gamma<3", "gamma>=1")
    )  # the pretended gamma of slot n is n
    with Client(url) as client:
        pull(client, dataset, 1, target, selection=chosen)
        assert {path for path in files(target) if path.startswith("manifest/")} == set(SECTIONS[:2])
        assert verify(target) == []
        (target / SECTIONS[1]).unlink()
        assert [(fault.path, fault.fault) for fault in verify(target)] == [(SECTIONS[1], "missing")]
        pull(client, dataset, 1, target)
        assert verify(target) == []
        assert set(SECTIONS) < files(target)


@pytest.mark.physics
def test_no_flipped_bit_of_a_section_or_the_manifest_is_silent(
    origin: tuple[str, str, PretendWorker], tmp_path: Path
) -> None:
    url, dataset, _ = origin
    rng = random.Random(1)
    target = tmp_path / "d"
    with Client(url) as client:
        pull(client, dataset, 1, target)
        for name in (MANIFEST_NAME, *SECTIONS):
            path = target / name
            intact = path.read_bytes()
            for bit in rng.sample(range(8 * len(intact)), 60):
                damaged = bytearray(intact)
                damaged[bit // 8] ^= 1 << bit % 8
                path.write_bytes(damaged)
                assert verify(target), f"bit {bit} of {name}"
            pull(client, dataset, 1, target)
            assert path.read_bytes() == intact


def test_a_section_that_is_damaged_in_the_store_is_made_again(
    origin: tuple[str, str, PretendWorker], application: FastAPI
) -> None:
    url, dataset, worker = origin
    context: Context = application.state.context
    with Client(url) as client:
        entry = client.contents(dataset, 1).manifest.sections[2]
        context.store.path(entry.sha256).write_bytes(b"{}")  # type: ignore[attr-defined]
        job = client.submit(rods(gamma=GAMMAS))
        sweep(context)
        detail = client.job(job.id)
        assert "its manifest was damaged or lost" in detail.message
        worker.finished_ids.clear()
        worker.work()
        assert client.job(job.id).state is JobState.succeeded_with_rejects
        assert [name.partition("-")[0] for name in worker.finished_ids] == ["publish"]
        assert context.store.holds(entry.sha256)
    with context.database.read() as connection:
        assert violations(connection) == []


def test_nothing_of_it_is_unused_and_it_is_found_again(
    origin: tuple[str, str, PretendWorker],
    application: FastAPI,
    settings: Settings,
    tmp_path: Path,
    clock: ManualClock,
) -> None:
    _, dataset, _ = origin
    context: Context = application.state.context
    (known,) = list_datasets(context)
    manifest = context.store.read(known.versions[0].manifest)
    needed = {
        file.sha256
        for file in Contents(
            Manifest.model_validate_json(manifest), lambda file: context.store.read(file.sha256)
        ).files()
    }
    free = {file.name for file in unused(context.database, context.store, older_than=-1)}
    assert not needed & free
    fresh = Context.open(
        settings.model_copy(
            update={"data": tmp_path / "fresh", "store": str(settings.data / "store")}
        )
    )
    start(fresh)
    first = next(iter(needed - {known.versions[0].manifest}))
    context.store.delete(first)
    (indexed,) = reindex(fresh.database, fresh.store)
    assert (indexed.fault, indexed.samples) == ("", 8)
    assert context.store.exists(first)  # from what the version shows
    assert [(each.id, each.versions[0].manifest) for each in list_datasets(fresh)] == [
        (dataset, known.versions[0].manifest)
    ]
    with fresh.database.read() as connection:
        assert violations(connection) == []
    fresh.close()


def test_a_version_with_a_damaged_section_is_not_believed(
    context: Context, worker: PretendWorker
) -> None:
    submit_job(context, parsed(rods(gamma=GAMMAS)), None)
    while not (publish := worker.lease(publish=1)):
        worker.finish(*worker.lease(simulate=9, render=9, pack=9))
    result = worker.result(publish[0].task)
    document = Manifest.model_validate_json(context.store.read(result.output.manifest))  # type: ignore[union-attr]
    context.store.path(document.sections[1].sha256).write_bytes(b"{}")  # type: ignore[attr-defined]
    assert worker.report((publish[0], result)) == ["accepted"]  # as a failure
    with context.database.read() as connection:
        ((reason, message),) = connection.exec_driver_sql(
            "SELECT reason, message FROM tasks WHERE state='soft_failed'"
        )
    assert reason == Reason.storage_error
    assert "the result does not hold" in message
