"""Costs by group, tasks that are left by group, losses, priorities"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_READY = sa.text("state = 'pending' AND waiting_on = 0")
_TIMINGS = (
    sa.Column("wall_count", sa.Integer(), nullable=False),
    sa.Column("wall_sum", sa.Float(), nullable=False),
    sa.Column("wall_squares", sa.Float(), nullable=False),
)


def upgrade() -> None:
    """Apply. What was measured so far is forgotten: it is not known of which group it was."""
    op.add_column("jobs", sa.Column("priority", sa.Integer(), nullable=False, server_default="0"))
    op.add_column("tasks", sa.Column("cost_group", sa.String(), nullable=False, server_default=""))
    op.add_column("tasks", sa.Column("losses", sa.Integer(), nullable=False, server_default="0"))
    op.drop_index("ix_tasks_ready", table_name="tasks")
    columns = ["stage", "build", "kind", "job", "seq", "cost_group"]
    op.create_index("ix_tasks_ready", "tasks", columns, sqlite_where=_READY, postgresql_where=_READY)
    op.drop_table("stage_timings")
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
        sa.PrimaryKeyConstraint("stage", "kind", "cost_group", name=op.f("pk_cost_groups")),
    )
    op.create_table(
        "job_groups",
        sa.Column("job", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("cost_group", sa.String(), nullable=False),
        sa.Column("left", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["job"], ["jobs.seq"], name=op.f("fk_job_groups_job_jobs")),
        sa.PrimaryKeyConstraint("job", "stage", "cost_group", name=op.f("pk_job_groups")),
    )
    op.execute(
        "INSERT INTO job_groups (job, stage, cost_group, \"left\") SELECT job, stage, '', SUM(count) FROM job_counts "
        "WHERE state NOT IN ('succeeded', 'rejected', 'failed', 'cancelled') GROUP BY job, stage"
    )


def downgrade() -> None:
    """Undo."""
    op.drop_table("job_groups")
    op.drop_table("cost_groups")
    op.create_table(
        "stage_timings",
        sa.Column("stage", sa.String(), nullable=False),
        sa.Column("kind", sa.String(), nullable=False),
        *_TIMINGS,
        sa.PrimaryKeyConstraint("stage", "kind", name=op.f("pk_stage_timings")),
    )
    op.drop_index("ix_tasks_ready", table_name="tasks")
    columns = ["stage", "build", "kind", "job", "seq"]
    op.create_index("ix_tasks_ready", "tasks", columns, sqlite_where=_READY, postgresql_where=_READY)
    with op.batch_alter_table("tasks", schema=None) as batch_op:
        batch_op.drop_column("losses")
        batch_op.drop_column("cost_group")
    with op.batch_alter_table("jobs", schema=None) as batch_op:
        batch_op.drop_column("priority")
