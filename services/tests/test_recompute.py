"""Damaged artifacts in the store: found when read, recomputed, and no job fails for good."""

import random
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, update
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.tasks import (
    PackOutput,
    RecordRef,
    RenderOutput,
    SimulateOutput,
    TaskResult,
)
from stickslip_schemas.store import DirectoryStore
from stickslip_services.client.verifying import verify
from stickslip_services.database.tables import dataset_versions, tasks
from stickslip_services.queue.background import sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.existing_datasets import SMALL_DATASET, check_existing_datasets
from stickslip_services.queue.submit import submit_job
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.worker import PretendWorker

pytestmark = pytest.mark.databases(slow=True)


def submit(context: Context, **spec: Any) -> str:
    return submit_job(context, parsed(rods(**spec)), None).id  # type: ignore[union-attr]


def rot(path: Path, rng: random.Random) -> None:
    """Flip a bit of a file, cut it, or remove it."""
    how = rng.randrange(3)
    if how == 0:
        path.unlink()
        return
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data if how == 1 else data[: len(data) // 2])


def directory(worker: PretendWorker) -> DirectoryStore:
    """Return where a worker publishes."""
    assert isinstance(worker.store, DirectoryStore)
    return worker.store


def artifacts(store: DirectoryStore) -> list[Path]:
    return sorted(path for path in (store.root / "artifacts").rglob("*") if path.is_file())


def check(context: Context) -> None:
    with context.database.read() as connection:
        assert violations(connection) == []


def finish(context: Context, worker: PretendWorker, clock: ManualClock, job: str) -> None:
    """Work until the job has ended well, and check its dataset."""
    for _ in range(12):
        worker.work()
        clock.advance(10)
        sweep(context)
    detail = show_job(context, job)
    assert detail.state is JobState.succeeded, detail.message
    assert detail.dataset is not None
    assert (
        verify(directory(worker).dataset_path(detail.dataset.dataset, detail.dataset.version)) == []
    )
    check(context)


@pytest.mark.slow
def test_100_rotten_artifacts_are_mended(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    rng = random.Random(3)
    gammas = [1.0, 2.0, 3.0]
    finish(context, worker, clock, submit(context, gamma=gammas, samples_per_shard=4))
    for round_ in range(10):
        for path in rng.sample(artifacts(directory(worker)), 10):
            rot(path, rng)
        finish(context, worker, clock, submit(context, gamma=gammas, samples_per_shard=4))
        if round_ % 5 == 4:  # the grid grows: results of the smaller one are read again
            gammas = [*gammas, 4.0 + round_]
            finish(context, worker, clock, submit(context, gamma=gammas, samples_per_shard=4))


def test_only_what_is_damaged_is_made_again(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    finish(context, worker, clock, submit(context))
    with context.database.read() as connection:
        output = connection.scalar(
            select(tasks.c.output).where(tasks.c.stage == "pack").order_by(tasks.c.seq).limit(1)
        )
    directory(worker).path(PackOutput.model_validate_json(str(output)).files[0].sha256).write_bytes(
        b"x"
    )
    worker.finished_ids.clear()
    job = submit(context)
    sweep(context)
    assert "1 of its files were damaged or lost" in show_job(context, job).message
    finish(context, worker, clock, job)
    assert [name.partition("-")[0] for name in worker.finished_ids] == ["pack", "publish"]


def test_a_rotten_trajectory_is_simulated_again(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """It is two stages away from the pack task that needs it, and needed by a render that comes
    later.
    """
    job = submit(context)
    worker.finish(*worker.lease(simulate=10))
    (render, *further) = worker.lease(render=10)
    worker.finish(*further)
    directory(worker).path(render.task.record.digest).unlink()  # type: ignore[union-attr]
    assert worker.finish(render) == ["accepted"]
    counts = show_job(context, job).progress.stages
    assert counts[Stage.simulate].counts == {TaskState.succeeded: 3, TaskState.pending: 1}
    assert counts[Stage.render].counts[TaskState.soft_failed] == 1
    check(context)
    clock.advance(5)
    sweep(context)
    assert worker.lease(render=10) == ()  # it waits for its simulation
    finish(context, worker, clock, job)


def test_a_pack_task_names_what_was_made_two_stages_before(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context)
    worker.finish(*worker.lease(simulate=10))
    worker.finish(*worker.lease(render=10))
    packs = worker.lease(pack=10)
    for slot in packs[0].task.slots:  # type: ignore[union-attr]
        directory(worker).path(slot.record.digest).write_bytes(b"")  # type: ignore[union-attr]
        directory(worker).path(slot.chunks["views"].digest).unlink()
    worker.finish(*packs)
    counts = show_job(context, job).progress.stages
    assert counts[Stage.simulate].counts[TaskState.pending] == 2
    assert counts[Stage.render].counts[TaskState.pending] == 2
    check(context)
    finish(context, worker, clock, job)


def test_a_disk_that_keeps_rotting_fails_the_job_and_a_resubmission_mends_it(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context, gamma=(1.0,), phi1=(1.0,))
    for _ in range(10):
        for lease in worker.lease(simulate=10):
            worker.finish(lease)
        for lease in worker.lease(render=10):
            directory(worker).path(lease.task.record.digest).unlink(missing_ok=True)  # type: ignore[union-attr]
            worker.finish(lease)
        clock.advance(10)
        sweep(context)
    assert show_job(context, job).state is JobState.failed
    check(context)
    finish(context, worker, clock, submit(context, gamma=(1.0,), phi1=(1.0,)))


def test_big_datasets_are_checked_by_the_coordinator_itself(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    finish(context, worker, clock, submit(context))
    with context.database.write() as connection:
        connection.execute(update(dataset_versions).values(bytes=SMALL_DATASET + 1))
    job = submit(context)
    detail = show_job(context, job)
    assert (detail.state, detail.message) == (
        JobState.queued,
        "the dataset exists already: its files are being checked",
    )
    sweep(context)
    assert show_job(context, job).state is JobState.queued
    check_existing_datasets(context)
    assert show_job(context, job).state is JobState.succeeded
    check(context)


@pytest.mark.parametrize("stage", ["simulate", "render", "pack"])
def test_a_result_that_is_not_in_the_store_is_refused(
    context: Context, worker: PretendWorker, clock: ManualClock, stage: str
) -> None:
    job = submit(context)
    if stage != "simulate":
        worker.finish(*worker.lease(simulate=10))
    if stage == "pack":
        worker.finish(*worker.lease(render=10))
    (lease,) = worker.lease(**{stage: 1})
    result = worker.result(lease.task)
    output = result.output
    if isinstance(output, SimulateOutput):
        output = output.model_copy(update={"record": RecordRef(digest="0" * 64, row=0)})
    elif isinstance(output, RenderOutput):
        chunk = output.chunks["views"]
        output = output.model_copy(
            update={"chunks": {"views": chunk.model_copy(update={"length": 10**6})}}
        )
    else:
        directory(worker).path(output.labels).unlink()  # type: ignore[union-attr]
    lie = TaskResult(outcome="succeeded", output=output)
    assert worker.report((lease, lie)) == ["accepted"]  # as a failure
    with context.database.read() as connection:
        query = "SELECT state, reason, message FROM tasks WHERE state = 'soft_failed'"
        ((state, reason, message),) = connection.exec_driver_sql(query)
    assert (state, reason) == (TaskState.soft_failed, Reason.storage_error)
    assert "must be in the store" in message
    finish(context, worker, clock, job)


def test_publishing_again_mends_an_artifact(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    digest = store.publish(b"right")
    for wrong in (b"wrong", b"", b"right and more"):
        store.path(digest).write_bytes(wrong)
        assert not store.holds(digest)
        assert store.publish(b"right") == digest
        assert store.read(digest) == b"right"
    inode = store.path(digest).stat().st_ino
    store.publish(b"right")
    assert store.path(digest).stat().st_ino == inode  # a whole one is left alone
