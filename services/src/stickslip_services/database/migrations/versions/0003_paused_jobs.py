"""Paused jobs are open"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

_BEFORE = "state IN ('queued', 'running', 'cancelling')"
_SINCE = "state IN ('queued', 'running', 'pausing', 'paused', 'cancelling')"


def upgrade() -> None:
    """Apply."""
    _index(_SINCE)


def downgrade() -> None:
    """Undo."""
    _index(_BEFORE)


def _index(condition: str) -> None:
    where = sa.text(condition)
    with op.batch_alter_table("jobs", schema=None) as batch_op:
        batch_op.drop_index("ix_jobs_open")
        batch_op.create_index("ix_jobs_open", ["seq"], unique=False, sqlite_where=where, postgresql_where=where)
