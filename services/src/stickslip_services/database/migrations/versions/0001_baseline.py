"""The tables of 0.1.0, and the triggers that keep the audit log append-only."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_WIDE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_REFUSAL = "the audit log is append-only"


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "api_keys",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("digest", sa.String(), nullable=False),
        sa.Column("scopes", sa.String(), nullable=False),
        sa.Column("project", sa.String(), server_default="", nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("revoked_at", sa.Float()),
        sa.PrimaryKeyConstraint("seq", name="pk_api_keys"),
        sa.UniqueConstraint("digest", name="uq_api_keys_digest"),
        sa.UniqueConstraint("id", name="uq_api_keys_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "audit_log",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("actor", sa.String(), nullable=False),
        sa.Column("action", sa.String(), nullable=False),
        sa.Column("subject", sa.String(), nullable=False),
        sa.Column("details", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_audit_log"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "certificates",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("digest", sa.String(), nullable=False),
        sa.Column("artifact", sa.String(), nullable=False),
        sa.Column("page", sa.String(), nullable=False),
        sa.Column("preset", sa.String(), nullable=False),
        sa.Column("sim_core", sa.String(), nullable=False),
        sa.Column("extent", sa.String(), nullable=False),
        sa.Column("passed", sa.Boolean(), nullable=False),
        sa.Column("protocols", sa.String(), server_default="", nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_certificates"),
        sa.UniqueConstraint("digest", name="uq_certificates_digest"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_certificates_preset_sim_core", "certificates", ["preset", "sim_core"])
    op.create_table(
        "cost_groups",
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("kind", sa.String(), nullable=False),
        sa.Column("cost_group", sa.String(), nullable=False),
        sa.Column("count", sa.Integer(), nullable=False),
        sa.Column("wall_sum", sa.Float(), nullable=False),
        sa.Column("wall_squares", sa.Float(), nullable=False),
        sa.Column("call_sum", sa.Float(), nullable=False),
        sa.Column("call_squares", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("stage", "kind", "cost_group", name="pk_cost_groups"),
    )
    op.create_table(
        "dataset_versions",
        sa.Column("dataset", sa.String(), nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("publish_task", _WIDE, nullable=False),
        sa.Column("manifest", sa.String()),
        sa.Column("group_digest", sa.String()),
        sa.Column("created_at", sa.Float()),
        sa.Column("sample_count", sa.Integer()),
        sa.Column("valid_count", sa.Integer()),
        sa.Column("bytes", _WIDE),
        sa.PrimaryKeyConstraint("dataset", "version", name="pk_dataset_versions"),
        sa.UniqueConstraint("publish_task", name="uq_dataset_versions_publish_task"),
    )
    op.create_table(
        "datasets",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String()),
        sa.Column("kind", sa.String(), nullable=False),
        sa.Column("spec_digest", sa.String(), nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_datasets"),
        sa.UniqueConstraint("id", name="uq_datasets_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "job_tasks",
        sa.Column("job", _WIDE, autoincrement=False, nullable=False),
        sa.Column("task", _WIDE, autoincrement=False, nullable=False),
        sa.Column("cached", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("job", "task", name="pk_job_tasks"),
        sqlite_with_rowid=False,
    )
    op.create_index("ix_job_tasks_task", "job_tasks", ["task"])
    op.create_table(
        "jobs",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String()),
        sa.Column("project", sa.String(), server_default="", nullable=False),
        sa.Column("traceparent", sa.String()),
        sa.Column("kind", sa.String(), nullable=False),
        sa.Column("spec", sa.Text(), nullable=False),
        sa.Column("sample_count", sa.Integer(), nullable=False),
        sa.Column("builds", sa.Text()),
        sa.Column("certificate", sa.String()),
        sa.Column("planned", sa.Integer(), server_default="0", nullable=False),
        sa.Column("planner", sa.String()),
        sa.Column("planner_until", sa.Float()),
        sa.Column("publish_task", _WIDE),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("reason", sa.String()),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("rejected_count", sa.Integer(), nullable=False),
        sa.Column("priority", sa.Integer(), server_default="0", nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("started_at", sa.Float()),
        sa.Column("finished_at", sa.Float()),
        sa.Column("dataset", sa.String()),
        sa.Column("version", sa.Integer()),
        sa.Column("manifest", sa.String()),
        sa.PrimaryKeyConstraint("seq", name="pk_jobs"),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        "ix_jobs_open",
        "jobs",
        ["seq"],
        sqlite_where=sa.text("state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')"),
        postgresql_where=sa.text("state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')"),
    )
    op.create_index("ix_jobs_publish_task", "jobs", ["publish_task"])
    op.create_table(
        "previews",
        sa.Column("task", _WIDE, autoincrement=False, nullable=False),
        sa.Column("digest", sa.String(), nullable=False),
        sa.PrimaryKeyConstraint("task", name="pk_previews"),
    )
    op.create_index("ix_previews_digest", "previews", ["digest"])
    op.create_table(
        "projects",
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("max_samples", _WIDE),
        sa.Column("max_jobs", sa.Integer()),
        sa.PrimaryKeyConstraint("name", name="pk_projects"),
    )
    op.create_table(
        "samples",
        sa.Column("job", _WIDE, autoincrement=False, nullable=False),
        sa.Column("slot", _WIDE, autoincrement=False, nullable=False),
        sa.Column("key", sa.LargeBinary(length=32), nullable=False),
        sa.Column("simulate_task", _WIDE, nullable=False),
        sa.Column("render_task", _WIDE),
        sa.Column("split", sa.Integer(), nullable=False),
        sa.Column("labels", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("job", "slot", name="pk_samples"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "task_counts",
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("count", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("stage", "state", name="pk_task_counts"),
    )
    op.create_table(
        "task_dependencies",
        sa.Column("task", _WIDE, autoincrement=False, nullable=False),
        sa.Column("depends_on", _WIDE, autoincrement=False, nullable=False),
        sa.PrimaryKeyConstraint("task", "depends_on", name="pk_task_dependencies"),
        sqlite_with_rowid=False,
    )
    op.create_index("ix_task_dependencies_depends_on", "task_dependencies", ["depends_on"])
    op.create_table(
        "tasks",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("key", sa.LargeBinary(length=32), nullable=False),
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("kind", sa.String(), nullable=False),
        sa.Column("build", sa.String(), nullable=False),
        sa.Column("payload", sa.Text(), nullable=False),
        sa.Column("preview", sa.Boolean(), nullable=False),
        sa.Column("cost_group", sa.String(), server_default="", nullable=False),
        sa.Column("job", _WIDE, nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("reason", sa.String()),
        sa.Column("message", sa.Text(), server_default="", nullable=False),
        sa.Column("waiting_on", sa.Integer(), nullable=False),
        sa.Column("token", sa.Integer(), server_default="0", nullable=False),
        sa.Column("owner", sa.String()),
        sa.Column("expires_at", sa.Float()),
        sa.Column("attempts", sa.Integer(), server_default="0", nullable=False),
        sa.Column("tries", sa.Integer(), server_default="0", nullable=False),
        sa.Column("losses", sa.Integer(), server_default="0", nullable=False),
        sa.Column("retry_at", sa.Float()),
        sa.Column("reported_token", sa.Integer()),
        sa.Column("reported_by", sa.String()),
        sa.Column("output", sa.Text()),
        sa.Column("cpu_seconds", sa.Float()),
        sa.Column("wall_seconds", sa.Float()),
        sa.Column("started_at", sa.Float()),
        sa.Column("finished_at", sa.Float()),
        sa.PrimaryKeyConstraint("seq", name="pk_tasks"),
        sa.UniqueConstraint("key", name="uq_tasks_key"),
    )
    op.create_index(
        "ix_tasks_leased",
        "tasks",
        ["owner"],
        sqlite_where=sa.text("owner IS NOT NULL"),
        postgresql_where=sa.text("owner IS NOT NULL"),
    )
    op.create_index(
        "ix_tasks_ready",
        "tasks",
        ["stage", "build", "kind", "job", "seq", "cost_group"],
        sqlite_where=sa.text("state = 'pending' AND waiting_on = 0"),
        postgresql_where=sa.text("state = 'pending' AND waiting_on = 0"),
    )
    op.create_index(
        "ix_tasks_retry",
        "tasks",
        ["retry_at"],
        sqlite_where=sa.text("state = 'soft_failed'"),
        postgresql_where=sa.text("state = 'soft_failed'"),
    )
    op.create_table(
        "webhooks",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("url", sa.String(), nullable=False),
        sa.Column("secret", sa.String(), nullable=False),
        sa.Column("position", _WIDE, nullable=False),
        sa.Column("next_at", sa.Float(), nullable=False),
        sa.Column("failures", sa.Integer(), nullable=False),
        sa.Column("failing_since", sa.Float()),
        sa.Column("fault", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_webhooks"),
        sa.UniqueConstraint("id", name="uq_webhooks_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "workers",
        sa.Column("seq", _WIDE, nullable=False),
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("builds", sa.Text(), nullable=False),
        sa.Column("slots", sa.Integer(), nullable=False),
        sa.Column("versions", sa.Text(), nullable=False),
        sa.Column("registered_at", sa.Float(), nullable=False),
        sa.Column("last_seen_at", sa.Float(), nullable=False),
        sa.Column("superseded", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_workers"),
        sa.UniqueConstraint("id", name="uq_workers_id"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_workers_name", "workers", ["name"])
    op.create_table(
        "events",
        sa.Column("id", _WIDE, nullable=False),
        sa.Column("job", _WIDE, nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("data", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_events_job_jobs"),
        sa.PrimaryKeyConstraint("id", name="pk_events"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_job_id", "events", ["job", "id"])
    op.create_table(
        "idempotency_keys",
        sa.Column("key", sa.String(), nullable=False),
        sa.Column("fingerprint", sa.String(), nullable=False),
        sa.Column("job", _WIDE, nullable=False),
        sa.Column("response", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_idempotency_keys_job_jobs"),
        sa.PrimaryKeyConstraint("key", name="pk_idempotency_keys"),
    )
    op.create_table(
        "job_counts",
        sa.Column("job", _WIDE, autoincrement=False, nullable=False),
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("count", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_job_counts_job_jobs"),
        sa.PrimaryKeyConstraint("job", "stage", "state", name="pk_job_counts"),
    )
    op.create_table(
        "job_groups",
        sa.Column("job", _WIDE, autoincrement=False, nullable=False),
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("cost_group", sa.String(), nullable=False),
        sa.Column("left", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_job_groups_job_jobs"),
        sa.PrimaryKeyConstraint("job", "stage", "cost_group", name="pk_job_groups"),
    )
    op.create_table(
        "job_stages",
        sa.Column("job", _WIDE, autoincrement=False, nullable=False),
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("cached", sa.Integer(), nullable=False),
        sa.Column("cpu_seconds", sa.Float(), server_default="0", nullable=False),
        sa.Column("wall_count", sa.Integer(), server_default="0", nullable=False),
        sa.Column("wall_sum", sa.Float(), server_default="0", nullable=False),
        sa.Column("wall_squares", sa.Float(), server_default="0", nullable=False),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name="fk_job_stages_job_jobs"),
        sa.PrimaryKeyConstraint("job", "stage", name="pk_job_stages"),
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
