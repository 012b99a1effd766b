"""Jobs whose dataset existed before their submission: its files are checked before the job ends.

A service reads all files of the dataset in the background. Damaged files are computed again.
"""

import logging
from collections.abc import Mapping
from typing import NamedTuple

from sqlalchemy import update
from stickslip_schemas.base import JobState, Sha256

from stickslip_services.catalog.versions import damaged_files, find_committed
from stickslip_services.database.statements import RowQuery
from stickslip_services.database.tables import dataset_versions
from stickslip_services.queue.context import Context
from stickslip_services.queue.job_states import complete_job, set_job_state
from stickslip_services.queue.rerun import rerun_producers, reset_tasks
from stickslip_services.queue.transaction import QueueTransaction

logger = logging.getLogger(__name__)

SMALL_DATASET = 64 * 2**20
"""Largest dataset that the sweep checks itself [bytes].

The check takes less than a second. Another service checks larger datasets, so that the sweep does
not wait for them.
"""


class _ExistingDataset(NamedTuple):
    """An active job, and the dataset that existed before its submission."""

    seq: int
    publish_task: int
    manifest: str
    group_digest: str
    bytes: int


_EXISTING_DATASETS = RowQuery(
    _ExistingDataset,
    "SELECT jobs.seq, jobs.publish_task, dataset_versions.manifest, dataset_versions.group_digest, "
    "dataset_versions.bytes FROM jobs "
    "JOIN tasks ON tasks.seq = jobs.publish_task AND tasks.state = 'succeeded' "
    "JOIN dataset_versions ON dataset_versions.publish_task = jobs.publish_task "
    "WHERE jobs.finished_at IS NULL AND jobs.state != 'cancelling' "
    "AND dataset_versions.manifest IS NOT NULL ORDER BY jobs.seq",
)


def check_small_datasets(context: Context) -> None:
    """Check small datasets, and end the jobs that wait for that."""
    _check_datasets(context, max_bytes=SMALL_DATASET)


def check_existing_datasets(context: Context) -> None:
    """Check datasets of all sizes, and end the jobs that wait for that."""
    _check_datasets(context, max_bytes=None)


def _check_datasets(context: Context, *, max_bytes: int | None) -> None:
    # The last check found no waiting job, and nothing has been written since. So an idle
    # coordinator does not ask the database again.
    writes = context.notifier.count
    if context.no_check_since == writes:
        return
    with context.database.read() as connection:
        existing = _EXISTING_DATASETS.rows(connection)
    if not existing:
        context.no_check_since = writes
    for dataset in existing:
        if max_bytes is not None and dataset.bytes > max_bytes:
            continue
        try:
            damaged = damaged_files(context.store, dataset.manifest, dataset.group_digest)
        except OSError as error:  # the store is out of reach: the next sweep tries again
            logger.warning("an existing dataset cannot be checked now: %s", error)
            continue
        with context.transaction() as tx:
            _end_or_rerun(tx, dataset, damaged)


def _end_or_rerun(
    tx: QueueTransaction, dataset: _ExistingDataset, damaged: Mapping[str, Sha256] | None
) -> None:
    """End a job whose dataset is intact, or else rerun the tasks that produced the damaged files.

    `damaged` has the paths and digests of the damaged files. It is None if the manifest itself
    cannot be trusted.
    """
    if dataset not in _EXISTING_DATASETS.rows(tx.connection):
        return  # cancelled, or ended by another check
    if damaged is not None and not damaged:
        # The check has read every file, so the scrub need not read them soon.
        is_version = dataset_versions.c.publish_task == dataset.publish_task
        intact = update(dataset_versions).where(is_version).values(scrubbed_at=tx.now, damaged=0)
        tx.connection.execute(intact)
        version = find_committed(tx.connection, dataset.publish_task)
        complete_job(tx, dataset.seq, version, "every result was cached")
        return
    subject = "its manifest was" if damaged is None else f"{len(damaged)} of its files were"
    message = (
        f"the dataset existed already, but {subject} damaged or lost in the store; missing files "
        "are recomputed"
    )
    set_job_state(tx, dataset.seq, JobState.queued, message=message)
    # The publish task runs again too, after the producers of the damaged files.
    reset_tasks(tx, [dataset.publish_task])
    rerun_producers(tx, dataset.publish_task, damaged.values() if damaged else ())
