"""The coordinator's own work: at its start, and at each sweep, once a second."""

import logging

from stickslip_services.access.keys import admit_local_worker
from stickslip_services.database.opening import upgrade
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import held_jobs, hold_jobs, release_jobs
from stickslip_services.queue.jobs import has_runnable_job
from stickslip_services.queue.lease import renew_all_leases
from stickslip_services.queue.planner import plan_waiting_jobs, release_claims
from stickslip_services.queue.recompute import CHECKED_AT_ONCE, check_made_datasets, fail_damaged_jobs
from stickslip_services.queue.retries import take_back
from stickslip_services.queue.workers import note_stranded

logger = logging.getLogger(__name__)


def start(context: Context) -> None:
    """Bring the database up to date, and resume the work of an earlier process."""
    with context.database.write() as connection:
        upgrade(connection)
        admit_local_worker(connection, context.settings.worker_key_path, context.clock())
        if context.database.is_alone(connection):  # no other coordinator could have taken a heartbeat
            renew_all_leases(connection, context.clock(), context.settings.lease_seconds)
            release_claims(connection)
    plan_waiting_jobs(context)


def sweep(context: Context) -> None:
    """Watch the store, plan jobs that wait, take back expired leases, retry tasks, and update messages."""
    fail_damaged_jobs(context)
    _watch_store(context)
    plan_waiting_jobs(context)
    take_back(context)
    note_stranded(context)
    check_made_datasets(context, at_most=CHECKED_AT_ONCE)


def _watch_store(context: Context) -> None:
    """Pause jobs while the store takes no results, and resume them afterwards."""
    trouble = context.store_watch.look()
    with context.database.read() as connection:
        due = has_runnable_job(connection) if trouble else bool(held_jobs(connection))
    if not due:
        return
    with context.ledger() as book:
        if trouble:
            hold_jobs(book, trouble)
        else:
            release_jobs(book)
    logger.warning("jobs are paused: %s", trouble) if trouble else logger.info("the store takes results again")
