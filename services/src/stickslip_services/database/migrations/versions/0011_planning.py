"""Jobs that are being planned, piece by piece"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_BEFORE = "state IN ('queued', 'running', 'pausing', 'paused', 'cancelling')"
_SINCE = "state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')"


def upgrade() -> None:
    """Apply. What there is has been planned whole, or not at all."""
    with op.batch_alter_table("jobs", schema=None) as batch_op:
        batch_op.add_column(sa.Column("certificate", sa.String()))
        batch_op.add_column(sa.Column("planned", sa.Integer(), nullable=False, server_default="0"))
        batch_op.add_column(sa.Column("planner", sa.String()))
        batch_op.add_column(sa.Column("planner_until", sa.Float()))
    op.execute("UPDATE jobs SET planned = sample_count WHERE builds IS NOT NULL")
    _index(_SINCE)


def downgrade() -> None:
    """Undo."""
    _index(_BEFORE)
    with op.batch_alter_table("jobs", schema=None) as batch_op:
        for name in ("planner_until", "planner", "planned", "certificate"):
            batch_op.drop_column(name)


def _index(condition: str) -> None:
    where = sa.text(condition)
    with op.batch_alter_table("jobs", schema=None) as batch_op:
        batch_op.drop_index("ix_jobs_open")
        batch_op.create_index("ix_jobs_open", ["seq"], unique=False, sqlite_where=where, postgresql_where=where)
