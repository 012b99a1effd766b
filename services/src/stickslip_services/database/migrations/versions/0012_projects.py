"""Projects of keys and jobs, with their quotas; traces of jobs"""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply. The keys and jobs that there are belong to the project without a name."""
    op.create_table(
        "projects",
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("max_samples", sa.BigInteger().with_variant(sa.Integer(), "sqlite")),
        sa.Column("max_jobs", sa.Integer()),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_projects")),
    )
    op.add_column("api_keys", sa.Column("project", sa.String(), nullable=False, server_default=""))
    op.add_column("jobs", sa.Column("project", sa.String(), nullable=False, server_default=""))
    op.add_column("jobs", sa.Column("traceparent", sa.String()))


def downgrade() -> None:
    """Undo."""
    with op.batch_alter_table("jobs", schema=None) as batch_op:
        batch_op.drop_column("traceparent")
        batch_op.drop_column("project")
    with op.batch_alter_table("api_keys", schema=None) as batch_op:
        batch_op.drop_column("project")
    op.drop_table("projects")
