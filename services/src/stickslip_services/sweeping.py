"""What nobody asks for and has to happen all the same: expired leases, due retries, queues that nobody serves."""

from sqlalchemy import Connection, select, text, update
from stickslip_schemas.builds import Builds
from stickslip_schemas.states import JobState, Reason

from stickslip_services import events
from stickslip_services.ledger import LIVE, Ledger
from stickslip_services.planning import stage_builds
from stickslip_services.retrying import find_held, lose, retry_due
from stickslip_services.settings import Settings
from stickslip_services.tables import jobs, tasks
from stickslip_services.workers import Worker, present_workers


def is_sweep_due(connection: Connection, now: float) -> bool:
    """Tell whether a lease has expired or a retry is due, without taking the write lock."""
    expired = select(tasks.c.seq).where(text("tasks.owner IS NOT NULL"), tasks.c.expires_at <= now).limit(1)
    due = select(tasks.c.seq).where(text("tasks.state = 'soft_failed'"), tasks.c.retry_at <= now).limit(1)
    return connection.scalar(expired) is not None or connection.scalar(due) is not None


def sweep(book: Ledger, settings: Settings) -> None:
    """Take expired leases back and let due retries wait for a worker again."""
    expired = find_held(book, expired=True)
    lose(book, expired, settings, message=f"no heartbeat for {settings.lease_seconds:g} s")
    retry_due(book)


def find_stranded(connection: Connection, now: float, settings: Settings) -> dict[int, str]:
    """Return, by job, the message that a planned live job should bear now; empty where it is being served."""
    seen_since = now - settings.lease_seconds
    alive = present_workers(connection, seen_since=seen_since)
    rows = connection.execute(
        select(jobs.c.seq, jobs.c.kind, jobs.c.builds, jobs.c.message).where(
            jobs.c.state.in_(LIVE), jobs.c.builds.is_not(None)
        )
    )
    return {
        row.seq: message
        for row in rows
        if (message := _stranded_message(row.kind, Builds.model_validate_json(row.builds), alive)) != row.message
    }


def note_stranded(connection: Connection, now: float, settings: Settings) -> None:
    """Let jobs say that they wait for a worker, or no longer do."""
    for job, message in find_stranded(connection, now, settings).items():
        reason = Reason.waiting_for_worker if message else None
        connection.execute(update(jobs).where(jobs.c.seq == job).values(reason=reason, message=message))
        state = JobState(connection.execute(select(jobs.c.state).where(jobs.c.seq == job)).scalar_one())
        events.append_job_state(connection, job, state, reason, message, now)


def renew_all_leases(connection: Connection, now: float, settings: Settings) -> None:
    """Give every lease its full time again: while the coordinator was down, no heartbeat could arrive."""
    connection.execute(
        update(tasks).where(text("tasks.owner IS NOT NULL")).values(expires_at=now + settings.lease_seconds)
    )


def _stranded_message(kind: str, builds: Builds, alive: list[Worker]) -> str:
    if not alive:
        return "no worker is connected; the job goes on when one is"
    makers = [worker for worker in alive if kind in worker.kinds]
    if not makers:
        return f"no connected worker makes {kind!r}; the job goes on when one does"
    needed = stage_builds(builds)
    missing = [
        stage for stage, build in needed.items() if all(worker.stage_builds[stage] != build for worker in makers)
    ]
    if missing:
        return (
            f"no connected worker has the builds that this job was planned for (stages: {', '.join(missing)}); it goes "
            "on when one has. To use the builds of today, cancel the job and submit it again."
        )
    return ""
