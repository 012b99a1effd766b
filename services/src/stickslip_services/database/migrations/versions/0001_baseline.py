"""The tables of 0.1.0, and the triggers that keep the audit log append-only.

Until 0.1.0 is released, the baseline makes the tables as `tables.py` has them, and its revision
changes with them: `opening.check` refuses the data directory of an earlier state. The release
writes the tables and the revision out here: a migration must not change later (CONTRIBUTING.md,
Release).
"""

from alembic import op
from stickslip_services.database.tables import metadata, schema_digest

revision = f"0001_{schema_digest()}"
down_revision = None

_REFUSAL = "the audit log is append-only"


def upgrade() -> None:
    """Make all tables."""
    metadata.create_all(op.get_bind(), checkfirst=False)
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
