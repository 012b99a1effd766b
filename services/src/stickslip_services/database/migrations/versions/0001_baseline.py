"""The tables of 0.1.0, and the triggers that keep the audit log append-only."""

from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_WIDE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_REFUSAL = "the audit log is append-only"


def _columns(kind: Any, names: str, *, nullable: bool = False, **options: Any) -> Iterator[sa.Column[Any]]:
    for name in names.split():
        yield sa.Column(name, kind, nullable=nullable, **options)


def _index(name: str, table: str, columns: list[str], where: str | None = None) -> None:
    condition = None if where is None else sa.text(where)
    op.create_index(name, table, columns, sqlite_where=condition, postgresql_where=condition)


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "api_keys",
        *_columns(_WIDE, "seq"),
        *_columns(sa.String, "id name digest scopes"),
        *_columns(sa.String, "project", server_default=""),
        *_columns(sa.Float, "created_at"),
        *_columns(sa.Float, "revoked_at", nullable=True),
        sa.PrimaryKeyConstraint("seq", name="pk_api_keys"),
        sa.UniqueConstraint("digest", name="uq_api_keys_digest"),
        sa.UniqueConstraint("id", name="uq_api_keys_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "audit_log",
        *_columns(_WIDE, "seq"),
        *_columns(sa.Float, "at"),
        *_columns(sa.String, "actor action subject"),
        *_columns(sa.Text, "details"),
        sa.PrimaryKeyConstraint("seq", name="pk_audit_log"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "certificates",
        *_columns(_WIDE, "seq"),
        *_columns(sa.String, "digest artifact page preset sim_core extent"),
        *_columns(sa.Boolean, "passed"),
        *_columns(sa.String, "protocols", server_default=""),
        *_columns(sa.Float, "created_at"),
        sa.PrimaryKeyConstraint("seq", name="pk_certificates"),
        sa.UniqueConstraint("digest", name="uq_certificates_digest"),
        sqlite_autoincrement=True,
    )
    _index("ix_certificates_preset_sim_core", "certificates", ["preset", "sim_core"])
    op.create_table(
        "cost_groups",
        *_columns(sa.String, "stage kind cost_group"),
        *_columns(sa.Integer, "count"),
        *_columns(sa.Float, "wall_sum wall_squares call_sum call_squares"),
        sa.PrimaryKeyConstraint("stage", "kind", "cost_group", name="pk_cost_groups"),
    )
    op.create_table(
        "dataset_versions",
        *_columns(sa.String, "dataset"),
        *_columns(sa.Integer, "version", autoincrement=False),
        *_columns(_WIDE, "publish_task"),
        *_columns(sa.String, "manifest group_digest", nullable=True),
        *_columns(sa.Float, "created_at", nullable=True),
        *_columns(sa.Integer, "sample_count valid_count", nullable=True),
        *_columns(_WIDE, "bytes", nullable=True),
        sa.PrimaryKeyConstraint("dataset", "version", name="pk_dataset_versions"),
        sa.UniqueConstraint("publish_task", name="uq_dataset_versions_publish_task"),
    )
    op.create_table(
        "datasets",
        *_columns(_WIDE, "seq"),
        *_columns(sa.String, "id kind spec_digest"),
        *_columns(sa.String, "name", nullable=True),
        sa.PrimaryKeyConstraint("seq", name="pk_datasets"),
        sa.UniqueConstraint("id", name="uq_datasets_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "job_tasks",
        *_columns(_WIDE, "job task", autoincrement=False),
        *_columns(sa.Boolean, "cached"),
        sa.PrimaryKeyConstraint("job", "task", name="pk_job_tasks"),
        sqlite_with_rowid=False,
    )
    _index("ix_job_tasks_task", "job_tasks", ["task"])
    op.create_table(
        "jobs",
        *_columns(_WIDE, "seq"),
        *_columns(sa.String, "id kind state"),
        *_columns(sa.String, "name traceparent certificate planner reason dataset manifest", nullable=True),
        *_columns(sa.String, "project", server_default=""),
        *_columns(sa.Text, "spec message"),
        *_columns(sa.Integer, "sample_count rejected_count"),
        *_columns(sa.Text, "builds", nullable=True),
        *_columns(sa.Integer, "planned priority", server_default="0"),
        *_columns(sa.Float, "planner_until started_at finished_at", nullable=True),
        *_columns(_WIDE, "publish_task given_up", nullable=True),
        *_columns(sa.Float, "created_at"),
        *_columns(sa.Integer, "version", nullable=True),
        sa.PrimaryKeyConstraint("seq", name="pk_jobs"),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )
    _index(
        "ix_jobs_open",
        "jobs",
        ["seq"],
        where="state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')",
    )
    _index("ix_jobs_publish_task", "jobs", ["publish_task"])
    op.create_table(
        "previews",
        *_columns(_WIDE, "task", autoincrement=False),
        *_columns(sa.String, "digest"),
        sa.PrimaryKeyConstraint("task", name="pk_previews"),
    )
    _index("ix_previews_digest", "previews", ["digest"])
    op.create_table(
        "projects",
        *_columns(sa.String, "name"),
        *_columns(_WIDE, "max_samples", nullable=True),
        *_columns(sa.Integer, "max_jobs", nullable=True),
        sa.PrimaryKeyConstraint("name", name="pk_projects"),
    )
    op.create_table(
        "samples",
        *_columns(_WIDE, "job slot", autoincrement=False),
        *_columns(sa.LargeBinary(32), "key"),
        *_columns(_WIDE, "simulate_task"),
        *_columns(_WIDE, "render_task", nullable=True),
        *_columns(sa.Integer, "split"),
        *_columns(sa.Text, "labels"),
        sa.PrimaryKeyConstraint("job", "slot", name="pk_samples"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "task_counts",
        *_columns(sa.String, "stage state"),
        *_columns(sa.Integer, "count"),
        sa.PrimaryKeyConstraint("stage", "state", name="pk_task_counts"),
    )
    op.create_table(
        "task_dependencies",
        *_columns(_WIDE, "task depends_on", autoincrement=False),
        sa.PrimaryKeyConstraint("task", "depends_on", name="pk_task_dependencies"),
        sqlite_with_rowid=False,
    )
    _index("ix_task_dependencies_depends_on", "task_dependencies", ["depends_on"])
    op.create_table(
        "tasks",
        *_columns(_WIDE, "seq job"),
        *_columns(sa.LargeBinary(32), "key"),
        *_columns(sa.String, "stage kind build state"),
        *_columns(sa.Text, "payload"),
        *_columns(sa.Boolean, "preview"),
        *_columns(sa.String, "cost_group", server_default=""),
        *_columns(sa.String, "reason owner reported_by", nullable=True),
        *_columns(sa.Text, "message", server_default=""),
        *_columns(sa.Integer, "waiting_on"),
        *_columns(sa.Integer, "token attempts tries losses", server_default="0"),
        *_columns(sa.Float, "expires_at retry_at cpu_seconds wall_seconds started_at finished_at", nullable=True),
        *_columns(sa.Integer, "reported_token", nullable=True),
        *_columns(sa.Text, "output", nullable=True),
        sa.PrimaryKeyConstraint("seq", name="pk_tasks"),
        sa.UniqueConstraint("key", name="uq_tasks_key"),
    )
    _index("ix_tasks_leased", "tasks", ["owner"], where="owner IS NOT NULL")
    _index(
        "ix_tasks_ready",
        "tasks",
        ["stage", "build", "kind", "job", "seq", "cost_group"],
        where="state = 'pending' AND waiting_on = 0",
    )
    _index("ix_tasks_retry", "tasks", ["retry_at"], where="state = 'soft_failed'")
    op.create_table(
        "uploads",
        *_columns(sa.String, "project digest"),
        sa.PrimaryKeyConstraint("project", "digest", name="pk_uploads"),
    )
    op.create_table(
        "webhooks",
        *_columns(_WIDE, "seq position"),
        *_columns(sa.String, "id project url secret"),
        *_columns(sa.Float, "next_at created_at"),
        *_columns(sa.Integer, "failures"),
        *_columns(sa.Float, "failing_since", nullable=True),
        *_columns(sa.Text, "fault"),
        sa.PrimaryKeyConstraint("seq", name="pk_webhooks"),
        sa.UniqueConstraint("id", name="uq_webhooks_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "workers",
        *_columns(_WIDE, "seq"),
        *_columns(sa.String, "id name"),
        *_columns(sa.Text, "builds condition versions"),
        *_columns(sa.Float, "registered_at last_seen_at"),
        *_columns(sa.Boolean, "superseded"),
        sa.PrimaryKeyConstraint("seq", name="pk_workers"),
        sa.UniqueConstraint("id", name="uq_workers_id"),
        sqlite_autoincrement=True,
    )
    _index("ix_workers_name", "workers", ["name"])
    op.create_table(
        "events",
        *_columns(_WIDE, "id job"),
        *_columns(sa.String, "name"),
        *_columns(sa.Text, "data"),
        *_columns(sa.Float, "created_at"),
        sa.PrimaryKeyConstraint("id", name="pk_events"),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_events_job_jobs"),
        sqlite_autoincrement=True,
    )
    _index("ix_events_job_id", "events", ["job", "id"])
    op.create_table(
        "idempotency_keys",
        *_columns(sa.String, "project key fingerprint"),
        *_columns(_WIDE, "job"),
        *_columns(sa.Text, "response"),
        *_columns(sa.Float, "created_at"),
        sa.PrimaryKeyConstraint("project", "key", name="pk_idempotency_keys"),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_idempotency_keys_job_jobs"),
    )
    op.create_table(
        "job_counts",
        *_columns(_WIDE, "job", autoincrement=False),
        *_columns(sa.String, "stage state"),
        *_columns(sa.Integer, "count"),
        sa.PrimaryKeyConstraint("job", "stage", "state", name="pk_job_counts"),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_job_counts_job_jobs"),
    )
    op.create_table(
        "job_groups",
        *_columns(_WIDE, "job", autoincrement=False),
        *_columns(sa.String, "stage cost_group"),
        *_columns(sa.Integer, "left"),
        sa.PrimaryKeyConstraint("job", "stage", "cost_group", name="pk_job_groups"),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_job_groups_job_jobs"),
    )
    op.create_table(
        "job_stages",
        *_columns(_WIDE, "job", autoincrement=False),
        *_columns(sa.String, "stage"),
        *_columns(sa.Integer, "cached"),
        *_columns(sa.Float, "cpu_seconds wall_sum wall_squares", server_default="0"),
        *_columns(sa.Integer, "wall_count", server_default="0"),
        sa.PrimaryKeyConstraint("job", "stage", name="pk_job_stages"),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_job_stages_job_jobs"),
    )
    if op.get_bind().dialect.name == "sqlite":
        for verb in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER audit_log_refuses_{verb.lower()} BEFORE {verb} ON audit_log "
                f"BEGIN SELECT RAISE(ABORT, '{_REFUSAL}'); END"
            )
    else:
        op.execute(
            "CREATE FUNCTION audit_log_refuses() RETURNS trigger LANGUAGE plpgsql AS "
            f"$$ BEGIN RAISE EXCEPTION '{_REFUSAL}'; END $$"
        )
        op.execute(
            "CREATE TRIGGER audit_log_refuses BEFORE UPDATE OR DELETE ON audit_log "
            "FOR EACH ROW EXECUTE FUNCTION audit_log_refuses()"
        )
