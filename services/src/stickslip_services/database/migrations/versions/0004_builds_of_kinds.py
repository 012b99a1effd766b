"""Builds of each kind"""

import json

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_WORKERS = sa.table("workers", sa.column("seq"), sa.column("builds"), sa.column("kinds"))
_JOBS = sa.table("jobs", sa.column("seq"), sa.column("builds"))
_PLANNED = sa.select(_JOBS.c.seq, _JOBS.c.builds).where(_JOBS.c.builds.is_not(None))


def upgrade() -> None:
    """Apply: a worker has builds of each kind. Builds from before stay what they were, so old jobs wait for them."""
    connection = op.get_bind()
    for seq, builds, kinds in connection.execute(sa.select(_WORKERS.c.seq, _WORKERS.c.builds, _WORKERS.c.kinds)).all():
        by_kind = json.dumps(dict.fromkeys(json.loads(kinds), _split(json.loads(builds))))
        connection.execute(sa.update(_WORKERS).where(_WORKERS.c.seq == seq).values(builds=by_kind))
    for seq, builds in connection.execute(
        sa.select(_JOBS.c.seq, _JOBS.c.builds).where(_JOBS.c.builds.is_not(None))
    ).all():
        own = json.dumps(_split(json.loads(builds)))
        connection.execute(sa.update(_JOBS).where(_JOBS.c.seq == seq).values(builds=own))
    with op.batch_alter_table("workers", schema=None) as batch_op:
        batch_op.drop_column("kinds")


def downgrade() -> None:
    """Undo."""
    connection = op.get_bind()
    with op.batch_alter_table("workers", schema=None) as batch_op:
        batch_op.add_column(sa.Column("kinds", sa.Text(), nullable=False, server_default="[]"))
    for seq, builds in connection.execute(sa.select(_WORKERS.c.seq, _WORKERS.c.builds)).all():
        by_kind = json.loads(builds)
        values = {"kinds": json.dumps(list(by_kind)), "builds": json.dumps(_join(next(iter(by_kind.values()))))}
        connection.execute(sa.update(_WORKERS).where(_WORKERS.c.seq == seq).values(**values))
    for seq, builds in connection.execute(
        sa.select(_JOBS.c.seq, _JOBS.c.builds).where(_JOBS.c.builds.is_not(None))
    ).all():
        own = json.dumps(_join(json.loads(builds)))
        connection.execute(sa.update(_JOBS).where(_JOBS.c.seq == seq).values(builds=own))


def _split(old: dict[str, str]) -> dict[str, str]:
    core = old["sim_core"]
    return {"sim_core": core, "simulate": core, "render": old["blender"], "pack": old["packer"]}


def _join(new: dict[str, str]) -> dict[str, str]:
    return {"sim_core": new["sim_core"], "blender": new["render"], "packer": new["pack"]}
