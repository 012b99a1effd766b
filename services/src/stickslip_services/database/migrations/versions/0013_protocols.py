"""Protocols of certificates"""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply. Protocols of older certificates are not known: they do not vouch where cloth touches cloth."""
    op.add_column("certificates", sa.Column("protocols", sa.String(), nullable=False, server_default=""))


def downgrade() -> None:
    """Undo."""
    with op.batch_alter_table("certificates", schema=None) as batch_op:
        batch_op.drop_column("protocols")
