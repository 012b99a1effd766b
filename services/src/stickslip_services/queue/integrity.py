"""Damage of the database: rows whose digest differs, and faults that the database reports.

| row | its digest covers | checked when |
|---|---|---|
| task | key, stage, build, payload | it is leased |
| result | key, state, reason, message, output | a dependent is leased; samples are listed |
| sample | all its columns | its shard or its dataset is made; it is listed |
| job | spec, builds, certificate | it is planned, served, packed, published or shown |

The coordinator mends nothing. `failures.fail_damaged` ends the jobs that need the row, with the
reason `damaged_row`. To go on, restore a backup of the database, or submit the spec again. A new
submission computes the damaged result again and keeps all others.

Any other error is a bug, and is treated like one.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from sqlalchemy.exc import DBAPIError
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.errors import DamagedRowError
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.rows import PlanInputs, SampleRow, TaskResultRow, TaskRow

DAMAGE_STATES = ("XX001", "XX002")
"""SQLSTATE of `data_corrupted` and `index_corrupted` of PostgreSQL."""

DAMAGE_CODES = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
"""Primary result codes of SQLite for a damaged file."""


def row_digest(*values: object) -> int:
    """Return 63 bits of a digest of the values of a row."""
    text = json.dumps(values, default=bytes.hex)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest()) >> 1


def payload_digest(key: bytes, stage: str, build: str, payload: str) -> int:
    """Return 63 bits of a digest of a task.

    Unlike `row_digest` it needs no JSON, because planning computes a million of these digests.
    """
    data = b"".join((key, stage.encode(), build.encode(), payload.encode()))
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest()) >> 1


class _PlannedTask(TaskRow, Protocol):
    @property
    def build(self) -> str: ...
    @property
    def payload(self) -> str: ...
    @property
    def payload_digest(self) -> int: ...


def check_task(task: _PlannedTask) -> None:
    """Raise DamagedRowError if a task differs from the planned one."""
    if payload_digest(task.key, task.stage, task.build, task.payload) != task.payload_digest:
        raise DamagedRowError(f"row {task.seq} of tasks")


def result_digest(
    key: bytes, state: str, reason: str | None, message: str, output: str | None
) -> int:
    """Return the digest of the result of a task."""
    return row_digest(key, state, reason, message, output)


def check_results(rows: Iterable[TaskResultRow]) -> None:
    """Raise DamagedRowError if the result of a task differs from the reported one."""
    damaged: list[TaskResultRow] = []
    for row in rows:
        digest = result_digest(row.key, row.state, row.reason, row.message, row.output)
        if digest != row.digest:
            damaged.append(row)
    # Name all damaged results: each of them must be computed again.
    if damaged:
        first = damaged[0]
        name = f"row {first.seq} of tasks, the result of {task_id(first.stage, first.key)}"
        raise DamagedRowError(name, results=[row.seq for row in damaged])


def sample_digest(
    job: int,
    slot: int,
    key: bytes,
    simulate_task: int,
    render_task: int | None,
    split: int,
    labels: str,
) -> int:
    """Return the digest of a row of `samples`."""
    return row_digest(job, slot, key, simulate_task, render_task, split, labels)


def check_samples(rows: Sequence[SampleRow], job: int, slots: Iterable[int]) -> None:
    """Raise DamagedRowError if rows of `samples` differ, or are not the rows of `slots`."""
    row_of_slot = {row.slot: row for row in rows}
    for slot in slots:
        row = row_of_slot.get(slot)
        # A missing row is damage too: the slot would silently disappear from the dataset.
        if row is None or sample_digest(*row[:-1]) != row.digest:
            raise DamagedRowError(f"row (job {job}, slot {slot}) of samples")


class _PlannedJob(Protocol):
    """A row of `jobs`."""

    @property
    def seq(self) -> int: ...
    @property
    def spec(self) -> str: ...
    @property
    def builds(self) -> str | None: ...
    @property
    def certificate(self) -> str | None: ...
    @property
    def digest(self) -> int: ...


def check_job(row: _PlannedJob) -> None:
    """Raise DamagedRowError if spec, builds or certificate of a job differ."""
    if row_digest(row.spec, row.builds, row.certificate) != row.digest:
        raise DamagedRowError(f"row {row.seq} of jobs")


def spec_of(row: _PlannedJob) -> JobSpec:
    """Return the spec of a job.

    Raises DamagedRowError if the row of the job is damaged.
    """
    check_job(row)
    return job_spec_adapter.validate_json(row.spec)


def plan_inputs_of(row: _PlannedJob) -> PlanInputs | None:
    """Return builds and certificate of a job, or None before its planning.

    Raises DamagedRowError if the row of the job is damaged.
    """
    check_job(row)
    if row.builds is None:
        return None
    return PlanInputs(Builds.model_validate_json(row.builds), row.certificate)


@contextmanager
def reported_damage() -> Iterator[None]:
    """Raise DamagedRowError if the database itself reports that its file is damaged."""
    try:
        yield
    except DBAPIError as error:
        if not _is_damage(error.orig):
            raise
        raise DamagedRowError(f"a page of the database file ({error.orig})") from error


def _is_damage(error: BaseException | None) -> bool:
    if isinstance(error, sqlite3.Error):
        code = getattr(error, "sqlite_errorcode", None)
        return code is not None and code & 0xFF in DAMAGE_CODES
    return getattr(error, "sqlstate", None) in DAMAGE_STATES
