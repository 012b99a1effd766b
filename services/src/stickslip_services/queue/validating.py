"""What a job of a spec would be, told without making one: by arithmetic, so that a grid of a million is no work."""

from sqlalchemy import Connection, func, select
from stickslip_schemas.base.states import TaskState
from stickslip_schemas.documents.responses import Validation
from stickslip_schemas.format.layout import bytes_estimate
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.grid import count
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.database.database import Database, batches
from stickslip_services.database.tables import dataset_versions, jobs, tasks
from stickslip_services.errors import KindNotAvailableError, PresetNotCertifiedError
from stickslip_services.queue.plan import Terms
from stickslip_services.queue.planning import collector_at_rest, expand
from stickslip_services.queue.terms import terms_for

LOOKED_UP = 10_000
"""The largest grid whose tasks are looked up one by one, to see which have a result."""

_SETTLED = [state for state in TaskState if state.is_settled]


def validate(database: Database, spec: JobSpec) -> Validation:
    """Return what a job of `spec` would be, and why it would be refused now where it would be."""
    counts = count(spec)
    raw = bytes_estimate(spec)
    terms, refusal = None, None
    with database.read() as connection:
        try:
            terms = terms_for(connection, spec)
        except (KindNotAvailableError, PresetNotCertifiedError) as error:
            refusal = str(error)
        compression = _compression(connection, spec.kind)
    return Validation(
        spec=spec,
        spec_digest=spec.content_digest,
        sample_count=counts.samples,
        simulation_count=counts.simulations,
        render_count=counts.renders,
        task_count=counts.tasks,
        expected_splits=counts.expected_splits,
        cached_count=None if terms is None else _cached(database, spec, terms),
        bytes_estimate=raw,
        stored_bytes_estimate=None if compression is None else round(raw * compression),
        certificate=None if terms is None else terms.certificate,
        refusal=refusal,
    )


def _cached(database: Database, spec: JobSpec, terms: Terms) -> int | None:
    """Return how many tasks have a result; None where the grid is too large to look."""
    with database.read() as connection:
        planned_so = (jobs.c.kind == spec.kind, jobs.c.builds == terms.builds.model_dump_json())
        if connection.scalar(select(jobs.c.seq).where(*planned_so).limit(1)) is None:
            return 0
        if spec.sample_count > LOOKED_UP:
            return None
    with collector_at_rest():
        plan = expand(spec, terms)
        with database.read() as connection:
            found = (
                connection.scalar(select(func.count()).where(tasks.c.key.in_(batch), tasks.c.state.in_(_SETTLED)))
                for batch in batches(plan.tasks)
            )
            return sum(number or 0 for number in found)


def _compression(connection: Connection, kind: str) -> float | None:
    """Return stored over raw bytes of the newest dataset of a kind; None where there is none."""
    row = connection.execute(
        select(jobs.c.spec, dataset_versions.c.bytes)
        .join(dataset_versions, dataset_versions.c.publish_task == jobs.c.publish_task)
        .where(jobs.c.kind == kind, dataset_versions.c.manifest.is_not(None))
        .order_by(dataset_versions.c.created_at.desc())
        .limit(1)
    ).one_or_none()
    return None if row is None else row.bytes / bytes_estimate(job_spec_adapter.validate_json(row.spec))
