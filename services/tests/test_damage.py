"""Bits that flip in rows of the database: what a dataset is made from is right, or the job says
that it is damaged.
"""

import random
import sqlite3
from pathlib import Path
from shutil import copytree
from typing import Any

import pytest
from sqlalchemy import Table, select, text
from sqlalchemy.exc import DatabaseError, OperationalError
from stickslip_schemas.base import JobState, Reason, TaskState
from stickslip_services.database.database import PageRequest
from stickslip_services.database.tables import jobs, samples, tasks
from stickslip_services.errors import DamagedRowError
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.integrity import reported_damage
from stickslip_services.queue.jobs import find_job, list_samples
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, parsed, rods
from stickslip_testing.worker import DirectApi, PretendWorker, rejection

FLIPS = 40
"""Of each run of the test."""

COLUMNS: dict[Table, tuple[str, ...]] = {
    tasks: (
        "key",
        "payload",
        "payload_digest",
        "state",
        "reason",
        "message",
        "output",
        "digest",
    ),
    samples: ("job", "slot", "key", "simulate_task", "render_task", "split", "labels", "digest"),
    jobs: ("spec", "builds", "digest"),
}


SPEC = rods(gamma=(1.0, 2.0, 3.0), samples_per_shard=4)


def pretend(context: Context) -> PretendWorker:
    """Return a worker that rejects one simulation."""
    return PretendWorker(
        DirectApi(context),
        context.store,
        judge=lambda task: (
            rejection() if task.stage == "simulate" and task.simulation.gamma == 2.0 else None
        ),
    ).register()


def half_made(place: Path, clock: ManualClock) -> str:
    """Make all results of a job but its shards; return its id."""
    context = Context.open(Settings(data=place, database=None, durable=False), clock)
    start(context)
    worker = pretend(context)
    job: str = submit_job(context, parsed(SPEC), None).id  # type: ignore[union-attr]
    worker.finish(*worker.lease(simulate=100))
    worker.finish(*worker.lease(render=100))
    context.close()
    return job


def flip(context: Context, rng: random.Random) -> str:
    """Flip a bit of a value that a dataset is made from; return where."""
    table = rng.choice([tasks, samples, samples, tasks, jobs])
    column = table.c[rng.choice(COLUMNS[table])]
    conditions = (
        [] if table is not tasks else [tasks.c.state.in_((TaskState.succeeded, TaskState.rejected))]
    )
    if column.name in ("key", "payload", "payload_digest"):
        conditions = []
    with context.database.write() as connection:
        rowid = {tasks: "seq", jobs: "seq", samples: "slot"}[table]
        rows = connection.execute(
            select(table.c[rowid], column).where(column.is_not(None), *conditions)
        ).all()
        if not rows:
            return "nothing"
        row, value = rng.choice(rows)
        data = bytearray(
            value.encode() if isinstance(value, str) else value if isinstance(value, bytes) else b""
        )
        if isinstance(value, int):
            new = f"{value ^ (1 << rng.randrange(max(1, value.bit_length())))}"
        elif not data:
            return "nothing"
        else:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            new = (
                f"x'{data.hex()}'" if isinstance(value, bytes) else f"CAST(x'{data.hex()}' AS TEXT)"
            )
        connection.execute(
            text(f"UPDATE OR IGNORE {table.name} SET {column.name} = {new} WHERE {rowid} = {row}")
        )
    return f"{table.name}.{column.name} of {row}"


def ended(context: Context, worker: PretendWorker, clock: ManualClock, job: str) -> Any:
    """Work until the job has ended; return it."""
    for _ in range(40):
        worker.work()
        clock.advance(40)
        sweep(context)
        with context.database.read() as connection:
            row: Any = find_job(connection, job)
        if not JobState(row.state).is_open:
            return row
    raise AssertionError(f"the job is {row.state}")


def read_samples(context: Context, job: str) -> Any:
    page = PageRequest(100, None)
    with context.database.read() as connection:
        return list_samples(connection, find_job(connection, job).seq, page, None)


def outcome_of_a_flip(
    place: Path, half: Path, job: str, seed: int, right: tuple[Any, Any] | None
) -> tuple[Any, Any]:
    """Flip a bit, make the dataset, and return its manifest and its samples.

    Compare them with the right ones.
    """
    clock = ManualClock()
    copytree(half, place)
    context = Context.open(Settings(data=place, database=None, durable=False), clock)
    start(context)
    where = "nothing" if right is None else flip(context, random.Random(seed))
    try:
        listed = read_samples(context, job)
    except DamagedRowError:
        listed = None
    sweep(context)
    worker = pretend(context)
    detail = ended(context, worker, clock, job)
    if detail.state == JobState.failed:
        assert detail.reason == Reason.damaged_row, (where, detail.reason, detail.message)
        assert "is damaged in the database. Restore a backup" in detail.message, where
        assert where != "nothing"
        manifest = None
        resubmit(context, worker, clock, right)
    else:
        manifest = detail.manifest
    with context.database.read() as connection:
        faults = violations(connection)
        # A damaged sample of the first job stays as it is.
        assert [fault for fault in faults if "rows of samples" not in fault] == [], where
    context.close()
    if right is not None:
        assert manifest in (right[0], None), where
        assert listed in (right[1], None), where
    return manifest, listed


def resubmit(context: Context, worker: PretendWorker, clock: ManualClock, right: Any) -> None:
    """Submit the spec of a job that failed for damage again: it gets the right dataset."""
    for _ in range(3):
        again = submit_job(context, parsed(SPEC), None)
        detail = ended(context, worker, clock, again.id)  # type: ignore[union-attr]
        if detail.state != JobState.failed:
            break
        assert detail.reason == Reason.damaged_row, detail.message
    # A damaged key of the publish task gives the dataset another version.
    assert detail.manifest == right[0] or detail.version == 2, detail.message


@pytest.mark.slow
def test_no_flip_in_a_row_is_silent(tmp_path: Path, clock: ManualClock) -> None:
    job = half_made(tmp_path / "half", clock)
    right = outcome_of_a_flip(tmp_path / "right", tmp_path / "half", job, 0, None)
    assert None not in right
    outcomes = [
        outcome_of_a_flip(tmp_path / str(n), tmp_path / "half", job, n, right) for n in range(FLIPS)
    ]
    assert any(manifest is None for manifest, _ in outcomes)


@pytest.mark.parametrize("stage", ["render", "pack"])
def test_a_bug_in_composing_a_lease_is_called_a_bug(
    context: Context,
    worker: PretendWorker,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    stage: str,
) -> None:
    job = submit_job(context, parsed(rods()), None)
    worker.finish(*worker.lease(simulate=100))
    if stage == "pack":
        worker.finish(*worker.lease(render=100))

    def planted(*_: object) -> None:
        raise TypeError("planted")

    monkeypatch.setattr(f"stickslip_services.queue.documents._{stage}_task", planted)
    assert worker.lease(**{stage: 1}) == ()
    assert "Traceback" in caplog.text
    assert "TypeError: planted" in caplog.text
    with context.database.read() as connection:
        (row,) = connection.execute(select(tasks).where(tasks.c.state == TaskState.failed))
        job_row: Any = find_job(connection, job.id)  # type: ignore[union-attr]
        assert violations(connection) == []
    assert row.reason == Reason.internal_error
    assert "damaged" not in row.message
    assert job_row.state == JobState.failed
    assert "internal_error" in job_row.message
    assert f"/v1/tasks/{stage}-" in job_row.message  # the reproducer
    assert "damaged" not in job_row.message

    # Once the bug is mended, the next submission goes on.
    monkeypatch.undo()
    again = submit_job(context, parsed(rods()), None)
    worker.work()
    with context.database.read() as connection:
        job_row = find_job(connection, again.id)  # type: ignore[union-attr]
    assert job_row.state == JobState.succeeded


def test_dependents_wait_again_for_a_damaged_result(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit_job(context, parsed(rods()), None)
    worker.finish(*worker.lease(simulate=100))
    worker.finish(*worker.lease(render=100))
    with context.database.write() as connection:
        connection.execute(text("UPDATE tasks SET output = output || ' ' WHERE stage = 'render'"))
    assert worker.lease(pack=100) == ()
    with context.database.read() as connection:
        assert violations(connection) == []

    # The next submission computes the damaged results again before it packs them.
    again = submit_job(context, parsed(rods()), None)
    assert worker.lease(pack=100) == ()
    assert ended(context, worker, clock, again.id).state == JobState.succeeded  # type: ignore[union-attr]


def test_a_damaged_page_of_the_file_is_damage_and_other_errors_are_not() -> None:
    corrupt = sqlite3.DatabaseError("database disk image is malformed")
    corrupt.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
    busy = sqlite3.OperationalError("database is locked")
    busy.sqlite_errorcode = sqlite3.SQLITE_BUSY
    with (
        pytest.raises(DamagedRowError, match="database disk image is malformed"),
        reported_damage(),
    ):
        raise DatabaseError("SELECT 1", None, corrupt)
    with pytest.raises(OperationalError), reported_damage():
        raise OperationalError("SELECT 1", None, busy)
    with pytest.raises(KeyError), reported_damage():
        raise KeyError("a bug")
