"""64-bit ids and sizes on PostgreSQL. SQLite's integers have 64 bits already"""

from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_COLUMNS = {
    "jobs": ("seq", "publish_task"),
    "tasks": ("seq", "job"),
    "events": ("id", "job"),
    "workers": ("seq",),
    "datasets": ("seq",),
    "certificates": ("seq",),
    "api_keys": ("seq",),
    "idempotency_keys": ("job",),
    "task_dependencies": ("task", "depends_on"),
    "job_tasks": ("job", "task"),
    "samples": ("job", "slot", "simulate_task", "render_task"),
    "previews": ("task",),
    "job_counts": ("job",),
    "job_stages": ("job",),
    "job_groups": ("job",),
    "dataset_versions": ("publish_task", "bytes"),
}
_COUNTED = (
    *((name, "seq") for name in ("jobs", "tasks", "workers", "datasets", "certificates", "api_keys")),
    ("events", "id"),
)


def upgrade() -> None:
    """Apply."""
    _retype("BIGINT")


def downgrade() -> None:
    """Undo. It fails, and changes nothing, where a value no longer fits."""
    _retype("INTEGER")


def _retype(name: str) -> None:
    if op.get_bind().dialect.name != "postgresql":
        return
    for table, columns in _COLUMNS.items():
        op.execute(f"ALTER TABLE {table} {', '.join(f'ALTER COLUMN {column} TYPE {name}' for column in columns)}")
    for table, column in _COUNTED:
        op.execute(f"ALTER SEQUENCE {table}_{column}_seq AS {name}")
