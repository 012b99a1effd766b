"""Alembic's entry: runs migrations in the transaction that `opening` has begun."""

from alembic import context
from stickslip_services.database.tables import metadata

# SQLite cannot alter most things: batch mode makes a new table and copies.
context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    render_as_batch=True,
)
context.run_migrations()
