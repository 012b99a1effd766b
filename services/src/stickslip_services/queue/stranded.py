"""Jobs that no connected worker can serve say so."""

from sqlalchemy import Connection, select
from stickslip_schemas.base.states import JobState, Reason
from stickslip_schemas.plan.builds import Builds

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import jobs
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.ledger import RUNNABLE
from stickslip_services.queue.workers import RegisteredWorker, present_workers, stage_builds
from stickslip_services.settings import Settings

_PLANNED = Prepared(
    select(jobs.c.seq, jobs.c.kind, jobs.c.builds, jobs.c.reason, jobs.c.message).where(
        jobs.c.state.in_(RUNNABLE), jobs.c.builds.is_not(None)
    )
)


def find_stranded(connection: Connection, now: float, settings: Settings) -> dict[int, str]:
    """Return, by job, the message that a planned live job should bear now; empty where it is being served."""
    seen_since = now - settings.lease_seconds
    alive = present_workers(connection, seen_since=seen_since)
    found = {}
    for row in _PLANNED.rows(connection):
        message = _stranded_message(row.kind, Builds.model_validate_json(row.builds), alive)
        if message != row.message and (message or row.reason == Reason.waiting_for_worker):
            found[row.seq] = message
    return found


def note_stranded(connection: Connection, now: float, settings: Settings) -> None:
    """Let jobs say that they wait for a worker, or no longer do."""
    for job, message in find_stranded(connection, now, settings).items():
        reason = Reason.waiting_for_worker if message else None
        state = JobState(connection.execute(select(jobs.c.state).where(jobs.c.seq == job)).scalar_one())
        set_job_state(connection, job, state, now, reason=reason, message=message)


def _stranded_message(kind: str, builds: Builds, alive: list[RegisteredWorker]) -> str:
    if not alive:
        return "no worker is connected; the job goes on when one is"
    makers = [worker for worker in alive if kind in worker.kinds]
    if not makers:
        return f"no connected worker makes {kind!r}; the job goes on when one does"
    needed = stage_builds(builds)
    missing = [
        stage for stage, build in needed.items() if all(worker.stage_builds(kind)[stage] != build for worker in makers)
    ]
    if missing:
        return (
            f"no connected worker has the builds that this job was planned for (stages: {', '.join(missing)}); it goes "
            "on when one has. To use the builds of today, cancel the job and submit it again."
        )
    return ""
