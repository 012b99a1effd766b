"""Submission of jobs.

A request with an idempotency key is answered once: a repeated one gets the same answer.
"""

from dataclasses import dataclass

from sqlalchemy import Connection, insert, select
from stickslip_schemas.base import JobState, Reason, sha256
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.access import audit_log
from stickslip_services.access.principals import current_principal
from stickslip_services.access.quotas import check_quota
from stickslip_services.catalog.inputs import check_files
from stickslip_services.database.tables import idempotency_keys, jobs
from stickslip_services.errors import IdempotencyKeyReusedError
from stickslip_services.queue.context import Context
from stickslip_services.queue.insertion import begin_planning, insert_job
from stickslip_services.queue.job_states import set_job_state
from stickslip_services.queue.jobs import show_new_job
from stickslip_services.queue.plan import plan_at_once, plan_inputs_for
from stickslip_services.queue.workers import NO_WORKER


@dataclass(frozen=True, slots=True)
class Replay:
    """The answer to the first request with an idempotency key."""

    job_id: str
    response: str


def submit_job(
    context: Context, spec: JobSpec, idempotency_key: str | None = None, *, priority: int = 0
) -> JobDetail | Replay:
    """Insert a job of a spec, or return the answer to an earlier request with the same key.

    Raises UnknownFileError, QuotaExceededError, KindNotAvailableError, PresetNotCertifiedError, or
    IdempotencyKeyReusedError.
    """
    check_files(context.database, context.store, spec)
    project = current_principal().project
    fingerprint = sha256(spec.model_dump_json().encode())
    with context.transaction() as tx:
        connection = tx.connection
        if idempotency_key:
            replay = _find_replay(connection, project, idempotency_key, fingerprint)
            if replay is not None:
                return replay
        check_quota(connection, project, spec.sample_count)

        inputs = plan_inputs_for(connection, spec)
        job = insert_job(tx, spec, priority=priority, project=project)
        if inputs is None:
            reason = Reason.waiting_for_worker
            set_job_state(tx, job, JobState.queued, reason=reason, message=NO_WORKER)
        else:
            begin_planning(tx, job, inputs, plan_at_once(context.settings, spec, inputs))

        detail = show_new_job(context, connection, job)
        details = {"name": spec.name, "samples": spec.sample_count, "priority": priority}
        audit_log.append(connection, "job.submit", detail.id, tx.now, **details)
        if idempotency_key:
            row = {"project": project, "key": idempotency_key, "fingerprint": fingerprint}
            answer = {"job": job, "created_at": tx.now, "response": detail.model_dump_json()}
            connection.execute(insert(idempotency_keys).values(**row, **answer))
    return detail


def _find_replay(connection: Connection, project: str, key: str, fingerprint: str) -> Replay | None:
    """Return the answer to an earlier request with this key.

    Raises IdempotencyKeyReusedError for another document.
    """
    row = connection.execute(
        select(idempotency_keys.c.fingerprint, idempotency_keys.c.response, jobs.c.id)
        .join(jobs, jobs.c.seq == idempotency_keys.c.job)
        .where(idempotency_keys.c.key == key, idempotency_keys.c.project == project)
    ).one_or_none()
    if row is None:
        return None
    if row.fingerprint != fingerprint:
        raise IdempotencyKeyReusedError(
            f"the Idempotency-Key {key!r} came with another document before"
        )
    return Replay(row.id, row.response)
