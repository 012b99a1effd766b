"""Removing versions, and files that nothing refers to."""

import os
import random
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from sqlalchemy import select, update
from stickslip_schemas.base import JobState
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.format.manifest import MANIFEST_NAME
from stickslip_schemas.store import DirectoryStore
from stickslip_services.catalog.versions import damaged_files
from stickslip_services.cli import app
from stickslip_services.database.database import Role
from stickslip_services.database.opening import opened
from stickslip_services.database.tables import dataset_versions
from stickslip_services.local.supervisor import locked
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.existing_datasets import check_existing_datasets
from stickslip_services.queue.maintenance import reindex, unused
from stickslip_services.queue.planner import Planner
from stickslip_services.queue.scrub import EVERY_SECONDS, scrub, scrub_when_idle
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, list_datasets, list_jobs, parsed, rods, show_job
from stickslip_testing.worker import DirectApi, PretendWorker

pytestmark = pytest.mark.databases(slow=True)

DAY = 24 * 3600.0


def submitted(context: Context, gamma: tuple[float, ...]) -> JobDetail:
    """Submit rods, and return the job."""
    job = submit_job(context, parsed(rods(gamma=gamma)), None)
    assert isinstance(job, JobDetail)
    return job


@pytest.fixture
def dataset_ids(settings: Settings) -> list[str]:
    """Two datasets that share two of their four simulations each; return their ids.

    The coordinator has ended.
    """
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    ids = []
    for gamma in ((1.0, 2.0), (2.0, 3.0)):
        job = submitted(context, gamma)
        worker.work()
        dataset = show_job(context, job.id).dataset
        assert dataset is not None
        ids.append(dataset.dataset)
    for file in unused(context.database, context.store, older_than=-1):
        context.store.delete(file.name)  # a pretended worker leaves something behind
    context.close()
    return ids


def run(settings: Settings, *arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments), "--data", str(settings.data)])


def artifacts(settings: Settings) -> dict[str, int]:
    return {
        path.name: path.stat().st_size
        for path in (Path(settings.store_place) / "artifacts").glob("*/*")
    }


def age(settings: Settings, seconds: float) -> None:
    """Let all files of the store be as old as that."""
    for path in Path(settings.store_place).rglob("*"):
        if path.is_file():
            os.utime(path, (time.time() - seconds,) * 2)


def look(settings: Settings) -> tuple[list[str], list[Any], Context]:
    context = Context.open(settings)
    start(context)
    with context.database.read() as connection:
        return violations(connection), list(list_datasets(context)), context


def test_nothing_that_is_in_use_is_unused(settings: Settings, dataset_ids: list[str]) -> None:
    before = artifacts(settings)
    _, datasets, context = look(settings)
    for dataset in datasets:
        (version,) = dataset.versions
        assert damaged_files(context.store, version.manifest, version.group) == {}
    context.close()
    age(settings, 30 * DAY)
    result = run(settings, "gc", "--delete", "--older-than", 0)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == "0 files, 0.0 MB, that nothing refers to were deleted\n"
    assert artifacts(settings) == before


def test_a_removed_version_frees_what_only_it_needed(
    settings: Settings, dataset_ids: list[str]
) -> None:
    first, second = dataset_ids
    before = artifacts(settings)
    result = run(settings, "rm", f"{first}:v1")
    assert result.exit_code == 0, result.stderr
    assert "with 1 jobs" in result.stdout
    assert not (Path(settings.store_place) / "datasets" / first).exists()
    assert artifacts(settings) == before
    dry = run(settings, "gc", "--older-than", 0)
    assert "may be deleted: add --delete" in dry.stdout
    assert artifacts(settings) == before
    assert run(settings, "gc", "--delete", "--older-than", 0).exit_code == 0
    after = artifacts(settings)
    assert 0 < len(after) < len(before)
    assert sum(after.values()) < sum(before.values())
    faults, datasets, context = look(settings)
    assert faults == []
    assert [dataset.id for dataset in datasets] == [second]
    (version,) = datasets[0].versions
    assert damaged_files(context.store, version.manifest, version.group) == {}
    assert len(list_jobs(context)) == 1
    context.close()


def test_a_removed_dataset_is_made_again(settings: Settings, dataset_ids: list[str]) -> None:
    manifest = Path(settings.store_place) / "datasets" / dataset_ids[0] / "v1" / MANIFEST_NAME
    content = manifest.read_bytes()
    run(settings, "rm", f"{dataset_ids[0]}:v1")
    run(settings, "gc", "--delete", "--older-than", 0)
    _, _, context = look(settings)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submitted(context, (1.0, 2.0))
    worker.work()
    assert show_job(context, job.id).state == JobState.succeeded
    simulated = [task for task in worker.finished_ids if task.startswith("simulate")]
    assert len(simulated) == 2  # the two that the other dataset does not share
    assert manifest.read_bytes() == content
    with context.database.read() as connection:
        assert violations(connection) == []
    context.close()


def test_young_files_are_kept(settings: Settings, dataset_ids: list[str]) -> None:
    stray = Path(settings.store_place) / "artifacts" / "ab" / ("ab" + "0" * 62)
    scratch = stray.with_name(f".{stray.name}.0123.tmp")
    for path in (stray, scratch):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x" * 1000)
    assert run(settings, "gc").stdout.startswith("0 files")
    age(settings, 2 * DAY)
    assert run(settings, "gc").stdout.startswith("2 files, 0.0 MB")
    assert run(settings, "gc", "--older-than", 72).stdout.startswith("0 files")
    run(settings, "gc", "--delete")
    assert not stray.exists()
    assert not scratch.exists()


def test_the_files_of_a_version_that_the_database_does_not_know_are_kept(
    settings: Settings, dataset_ids: list[str]
) -> None:
    """As after a database was restored from an old backup."""
    directory = Path(settings.store_place) / "datasets" / dataset_ids[0] / "v1"
    away = settings.data / "away"
    directory.rename(away)
    run(settings, "rm", f"{dataset_ids[0]}:v1")
    away.mkdir(exist_ok=True)
    directory.parent.mkdir(exist_ok=True)
    away.rename(directory)
    run(settings, "gc", "--delete", "--older-than", 0)
    assert CliRunner().invoke(app, ["verify", str(directory)]).exit_code == 0
    with opened(settings, Role.upkeep) as database:
        indexed = reindex(database, DirectoryStore(settings.store_place))
        assert sorted(version.is_new for version in indexed) == [False, True]


def test_a_manifest_that_cannot_be_read_stops_it(
    settings: Settings, dataset_ids: list[str]
) -> None:
    _, datasets, context = look(settings)
    context.close()
    context.store.delete(datasets[0].versions[0].manifest)
    before = artifacts(settings)
    result = run(settings, "gc", "--delete", "--older-than", 0)
    assert result.exit_code == 1
    assert "No such file" in result.stderr
    assert artifacts(settings) == before


def test_a_version_that_is_being_made_is_not_removed(
    settings: Settings, dataset_ids: list[str]
) -> None:
    _, datasets, context = look(settings)
    PretendWorker(DirectApi(context), context.store).register()
    (version,) = next(dataset.versions for dataset in datasets if dataset.id == dataset_ids[0])
    context.store.delete(version.manifest)  # so that a job makes it once more
    again = submitted(context, (1.0, 2.0))
    context.close()
    result = run(settings, "rm", f"{dataset_ids[0]}:v1")
    assert result.exit_code == 1
    assert f"the job {again.id} is" in result.stderr
    assert (
        Path(settings.store_place) / "datasets" / dataset_ids[0] / "v1" / MANIFEST_NAME
    ).exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("rm", "ds-0000000000000000:v1"),
            "there is no version 1 of a dataset 'ds-0000000000000000'",
        ),
        (("rm", "ds-0000000000000000"), "must be DATASET:vN, as in ds-0123456789abcdef:v1"),
        (("rm", "../../etc:v1"), "must be DATASET:vN, as in ds-0123456789abcdef:v1"),
    ],
)
def test_what_does_not_exist_is_refused(
    settings: Settings, dataset_ids: list[str], arguments: tuple[str, ...], message: str
) -> None:
    result = run(settings, *arguments)
    assert (result.exit_code, message in result.stderr) == (1, True), result.stderr


def test_a_running_service_is_refused(settings: Settings, dataset_ids: list[str]) -> None:
    with locked(settings.data):
        result = run(settings, "gc")
    assert (result.exit_code, "is in use by another" in result.stderr) == (1, True)


def test_a_missing_database_is_refused(tmp_path: Path) -> None:
    empty = CliRunner().invoke(app, ["gc", "--data", str(tmp_path / "nothing")])
    assert (empty.exit_code, "does not exist" in empty.stderr) == (1, True)


def finish_repairs(context: Context) -> None:
    """Let a service with a worker go on until no job is left."""
    worker = PretendWorker(DirectApi(context), context.store).register()
    for _ in range(12):
        Planner(context).run()
        check_existing_datasets(context)
        worker.work()
        assert isinstance(context.clock, ManualClock)
        context.clock.advance(10)
        sweep(context)
    assert {job.state for job in list_jobs(context)} == {JobState.succeeded}


def test_scrubbing_finds_all_rot_and_it_is_mended_in_all_versions(
    settings: Settings, dataset_ids: list[str]
) -> None:
    """The versions share files by their bytes, as hard links do."""
    rng = random.Random(5)
    paths = sorted(
        path for path in (Path(settings.store_place) / "datasets").rglob("*") if path.is_file()
    )
    before = {path: path.read_bytes() for path in paths}
    for round_ in range(5):
        rotten = {path for path in rng.sample(paths, 4) if path.stat().st_size}
        for path in rotten:
            data = bytearray(path.read_bytes())
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            path.write_bytes(data)
        result = run(settings, "scrub", "--rate", 1000)
        assert result.exit_code == 1, round_
        damaged = {path for path in paths if path.read_bytes() != before[path]}
        reported = {tuple(line.split("  ")) for line in result.stdout.splitlines()}
        for path in damaged:
            dataset, version, *names = path.relative_to(
                Path(settings.store_place) / "datasets"
            ).parts
            listed = {
                name for version_name, name in reported if version_name == f"{dataset}:{version}"
            }
            assert listed & {"/".join(names), MANIFEST_NAME}
        clock = ManualClock()
        clock.now = time.time() + 3600  # a clock that is ahead
        context = Context.open(settings, clock)
        finish_repairs(context)
        context.close()
        assert all(path.read_bytes() == data for path, data in before.items())
        assert run(settings, "scrub").exit_code == 0


def test_a_coordinator_scrubs_when_it_is_idle(settings: Settings, dataset_ids: list[str]) -> None:
    context = Context.open(settings, ManualClock())
    now = context.clock()
    with context.database.write() as connection:
        connection.execute(update(dataset_versions).values(scrubbed_at=now))
    assert scrub(context, before=now - EVERY_SECONDS) is None  # they have just been made
    with context.database.write() as connection:
        connection.execute(update(dataset_versions).values(scrubbed_at=now - EVERY_SECONDS - 1))
    (Path(settings.store_place) / "datasets" / dataset_ids[0] / "v1" / "README.md").write_bytes(
        b"rot"
    )
    submitted(context, (7.0,))
    scrub_when_idle(context)  # a job runs
    assert scrubbed(context) == []
    finish_repairs(context)
    for count in (2, 3, 3):
        scrub_when_idle(context)
        finish_repairs(context)
        assert len(scrubbed(context)) == count
    assert run(settings, "scrub").exit_code == 0
    context.close()


def scrubbed(context: Context) -> list[str]:
    with context.database.read() as connection:
        read = dataset_versions.c.scrubbed_at > context.clock() - DAY
        return list(
            connection.scalars(
                select(dataset_versions.c.dataset).where(read, dataset_versions.c.version == 1)
            )
        )
