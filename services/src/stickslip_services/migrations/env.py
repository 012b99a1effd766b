"""Alembic's entry: runs migrations on the database that `migrate` names."""

from alembic import context
from sqlalchemy import create_engine
from stickslip_services.tables import metadata

engine = create_engine(context.config.get_main_option("sqlalchemy.url") or "")
with engine.connect() as connection:
    # SQLite cannot alter most things: batch mode makes a new table and copies.
    context.configure(connection=connection, target_metadata=metadata, render_as_batch=True)
    with context.begin_transaction():
        context.run_migrations()
engine.dispose()
