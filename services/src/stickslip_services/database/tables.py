"""The tables of the coordinator's database.

Tasks are global and keyed by content; jobs point at the tasks that they need. Inside the database a
task is its `seq` (8 bytes in five indexes, where its name would be 73); outside it is
`<stage>-<key>`. Times are seconds since 1970.
"""

import hashlib
from typing import Any

import sqlalchemy as sa

metadata = sa.MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)


def _partial(condition: str) -> dict[str, Any]:
    return {"sqlite_where": sa.text(condition), "postgresql_where": sa.text(condition)}


_Wide = sa.BigInteger().with_variant(sa.Integer, "sqlite")
"""64 bits: SQLite's INTEGER has them, and it must be called so to be a rowid."""


def _table(
    name: str,
    *columns: sa.Column[Any] | sa.Index,
    sqlite_with_rowid: bool = True,
    sqlite_autoincrement: bool = False,
) -> sa.Table:
    return sa.Table(
        name,
        metadata,
        *columns,
        sqlite_with_rowid=sqlite_with_rowid,
        sqlite_autoincrement=sqlite_autoincrement,
    )


def _numbered(name: str, *columns: sa.Column[Any] | sa.Index) -> sa.Table:
    """Return a table whose rows have numbers, `seq`, none of which is given again."""
    return _table(
        name, sa.Column("seq", _Wide, primary_key=True), *columns, sqlite_autoincrement=True
    )


def _key(name: str) -> sa.Column[Any]:
    return sa.Column(name, _Wide, primary_key=True, autoincrement=False)


workers = _numbered(
    "workers",
    sa.Column("id", sa.String, nullable=False, unique=True),
    sa.Column("name", sa.String, nullable=False, index=True),
    sa.Column("builds", sa.Text, nullable=False),  # JSON: by kind
    sa.Column("condition", sa.Text, nullable=False),  # JSON
    sa.Column("versions", sa.Text, nullable=False),  # JSON
    sa.Column("registered_at", sa.Float, nullable=False),
    sa.Column("last_seen_at", sa.Float, nullable=False),
    sa.Column("superseded", sa.Boolean, nullable=False),
)

jobs = _numbered(
    "jobs",
    sa.Column("id", sa.String, nullable=False, unique=True),
    sa.Column("name", sa.String),
    sa.Column(
        "project", sa.String, nullable=False, server_default=""
    ),  # of the key that it was submitted with
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("spec", sa.Text, nullable=False),  # JSON
    sa.Column("sample_count", sa.Integer, nullable=False),
    sa.Column("builds", sa.Text),  # JSON; null until its planning begins
    sa.Column("certificate", sa.String),  # digest of its certificate when planning began
    # Of spec, builds and certificate (queue/integrity.py).
    sa.Column("digest", _Wide, nullable=False),
    sa.Column(
        "planned", sa.Integer, nullable=False, server_default="0"
    ),  # number of samples whose tasks are inserted
    sa.Column("planner", sa.String),  # the coordinator that plans it
    sa.Column("planner_until", sa.Float),  # when another coordinator may go on with that
    sa.Column("publish_task", _Wide, index=True),  # null until the job is planned
    sa.Column("state", sa.String, nullable=False),
    sa.Column("reason", sa.String),
    sa.Column("message", sa.Text, nullable=False),
    sa.Column("rejected_count", sa.Integer, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False, server_default="0"),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("started_at", sa.Float),
    sa.Column("finished_at", sa.Float),
    # It has ended, and rows of it may be left in `ready_tasks` (queue/leaving.py).
    sa.Column("leaves_queue", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("dataset", sa.String),
    sa.Column("version", sa.Integer),
    sa.Column("manifest", sa.String),
    # The state is in the index: which jobs may be served, planned or settled is asked all the time.
    sa.Index("ix_jobs_open", "state", "seq", **_partial("finished_at IS NULL")),
    sa.Index("ix_jobs_unplanned", "seq", **_partial("finished_at IS NULL AND builds IS NULL")),
    sa.Index("ix_jobs_leaves_queue", "seq", **_partial("leaves_queue")),
)

idempotency_keys = _table(
    "idempotency_keys",
    sa.Column("project", sa.String, primary_key=True),
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("fingerprint", sa.String, nullable=False),
    sa.Column("job", _Wide, sa.ForeignKey("jobs.seq"), nullable=False),
    sa.Column("response", sa.Text, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
)

tasks = _table(
    "tasks",
    sa.Column("seq", _Wide, primary_key=True),
    # The content key: equal work is one task, which belongs to no job (see `job_tasks`).
    sa.Column("key", sa.LargeBinary(32), nullable=False, unique=True),
    sa.Column("stage", sa.String, nullable=False),
    sa.Column("kind", sa.String, nullable=False),
    # The build of its stage: a worker must have it to run the task.
    sa.Column("build", sa.String, nullable=False),
    # JSON: the task without the results of its dependencies.
    sa.Column("payload", sa.Text, nullable=False),
    # Of key, stage, build and payload (queue/integrity.py).
    sa.Column("payload_digest", _Wide, nullable=False),
    sa.Column("preview", sa.Boolean, nullable=False),
    # Tasks of one group cost about the same.
    sa.Column("cost_group", sa.String, nullable=False, server_default=""),
    sa.Column("state", sa.String, nullable=False),
    sa.Column("reason", sa.String),
    sa.Column("message", sa.Text, nullable=False, server_default=""),
    # Dependencies without a result.
    sa.Column("waiting_on", sa.Integer, nullable=False),
    # The fencing token: it increments at each lease.
    sa.Column("token", sa.Integer, nullable=False, server_default="0"),
    # The worker, while the task is leased or running.
    sa.Column("owner", sa.String),
    # The job whose share of the workers the lease uses.
    sa.Column("leased_for", _Wide),
    sa.Column("expires_at", sa.Float),
    # How often it was started, how many of these attempts failed, and how many a lost worker ended.
    sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
    sa.Column("tries", sa.Integer, nullable=False, server_default="0"),
    sa.Column("losses", sa.Integer, nullable=False, server_default="0"),
    sa.Column("retry_at", sa.Float),
    sa.Column("reported_token", sa.Integer),
    sa.Column("reported_by", sa.String),
    # JSON: the result.
    sa.Column("output", sa.Text),
    # Of key, state, reason, message and output, while it has a result (queue/integrity.py).
    sa.Column("digest", _Wide),
    sa.Column("cpu_seconds", sa.Float),
    sa.Column("wall_seconds", sa.Float),
    sa.Column("started_at", sa.Float),
    sa.Column("finished_at", sa.Float),
    sa.Index("ix_tasks_owner", "owner", **_partial("owner IS NOT NULL")),
    sa.Index("ix_tasks_leased", "stage", "leased_for", **_partial("owner IS NOT NULL")),
    sa.Index("ix_tasks_retry", "retry_at", **_partial("state = 'soft_failed'")),
)

# The bulk tables have no foreign keys: checking them would double the time of a plan, rows are only
# ever written by insertion.py and ready.py, and the tests check that both ends exist.

task_dependencies = _table(
    "task_dependencies",
    _key("task"),
    sa.Column("depends_on", _Wide, primary_key=True, autoincrement=False, index=True),
    sqlite_with_rowid=False,
)

job_tasks = _table(
    "job_tasks",
    _key("job"),
    sa.Column("task", _Wide, primary_key=True, autoincrement=False, index=True),
    # It had its result before the job was submitted.
    sa.Column("cached", sa.Boolean, nullable=False),
    sqlite_with_rowid=False,
)

# The queue: a row for each active job that needs a task that can run now. The key begins with the
# task, so that a lease deletes the rows of its tasks by the key. Rows of a job that has ended are
# removed in the background (queue/leaving.py); nobody reads them.
ready_tasks = _table(
    "ready_tasks",
    _key("task"),
    _key("job"),
    sa.Column("stage", sa.String, nullable=False),
    sa.Column("cost_group", sa.String, nullable=False),
    sa.Index("ix_ready_tasks_lease", "job", "stage", "task", "cost_group"),
    sqlite_with_rowid=False,
)

samples = _table(
    "samples",
    _key("job"),
    _key("slot"),
    sa.Column("key", sa.LargeBinary(32), nullable=False),
    sa.Column("simulate_task", _Wide, nullable=False),
    sa.Column("render_task", _Wide),
    sa.Column("split", sa.Integer, nullable=False),
    sa.Column("labels", sa.Text, nullable=False),  # JSON: the point of the grid
    sa.Column("digest", _Wide, nullable=False),  # of the other columns (queue/integrity.py)
    sqlite_with_rowid=False,
)

previews = _table(
    "previews", _key("task"), sa.Column("digest", sa.String, nullable=False, index=True)
)

# Totals of results, written once a task, when it gets its result. Tasks in flight are few, and are
# counted when progress is shown.
job_totals = _table(
    "job_totals",
    sa.Column("job", _Wide, sa.ForeignKey("jobs.seq"), primary_key=True, autoincrement=False),
    sa.Column("stage", sa.String, primary_key=True),
    sa.Column("cost_group", sa.String, primary_key=True),
    sa.Column("total", sa.Integer, nullable=False, server_default="0"),
    # Tasks that had their result before the job was submitted; their cost is not the job's.
    sa.Column("cached", sa.Integer, nullable=False, server_default="0"),
    sa.Column("succeeded", sa.Integer, nullable=False, server_default="0"),
    sa.Column("rejected", sa.Integer, nullable=False, server_default="0"),
    sa.Column("failed", sa.Integer, nullable=False, server_default="0"),
    sa.Column("cpu_seconds", sa.Float, nullable=False, server_default="0"),
    sa.Column("wall_count", sa.Integer, nullable=False, server_default="0"),
    sa.Column("wall_sum", sa.Float, nullable=False, server_default="0"),
    sa.Column("wall_squares", sa.Float, nullable=False, server_default="0"),
    # When the last result was added: a job without progress shows by it.
    sa.Column("updated_at", sa.Float),
    sa.Index("ix_job_totals_failed", "job", **_partial("failed > 0")),
)

cost_groups = _table(
    "cost_groups",
    sa.Column("stage", sa.String, primary_key=True),
    sa.Column("kind", sa.String, primary_key=True),
    sa.Column("cost_group", sa.String, primary_key=True),
    sa.Column(
        "count", sa.Integer, nullable=False
    ),  # of finished tasks; halved with the sums at times (queue/eta.py)
    sa.Column("wall_sum", sa.Float, nullable=False),  # of a task's share of the call that made it
    sa.Column("wall_squares", sa.Float, nullable=False),
    sa.Column("call_sum", sa.Float, nullable=False),  # of the whole call
    sa.Column("call_squares", sa.Float, nullable=False),
)

datasets = _numbered(
    "datasets",
    sa.Column("id", sa.String, nullable=False, unique=True),
    sa.Column("name", sa.String),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("spec_digest", sa.String, nullable=False),
)

dataset_versions = _table(
    "dataset_versions",
    sa.Column("dataset", sa.String, primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("publish_task", _Wide, nullable=False, unique=True),
    sa.Column("manifest", sa.String),  # null: the number is taken, the version is not committed
    sa.Column("group_digest", sa.String),  # of the root's zarr.json
    sa.Column("created_at", sa.Float),
    sa.Column("sample_count", sa.Integer),
    sa.Column("valid_count", sa.Integer),
    sa.Column("bytes", _Wide),
    sa.Column("scrubbed_at", sa.Float),  # when all its files were read last, or made
    sa.Column(
        "damaged", sa.Integer, nullable=False, server_default="0"
    ),  # files that were damaged then
)

certificates = _numbered(
    "certificates",
    sa.Column("digest", sa.String, nullable=False, unique=True),
    sa.Column("artifact", sa.String, nullable=False),  # the document
    sa.Column("preset", sa.String, nullable=False),
    sa.Column("sim_core", sa.String, nullable=False),
    sa.Column("extent", sa.String, nullable=False),
    sa.Column("passed", sa.Boolean, nullable=False),
    sa.Column(
        "protocols", sa.String, nullable=False, server_default=""
    ),  # names, with spaces between
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Index("ix_certificates_preset_sim_core", "preset", "sim_core"),
)

uploads = _table(  # who has uploaded which artifact
    "uploads",
    sa.Column("project", sa.String, primary_key=True),
    sa.Column("digest", sa.String, primary_key=True),
)

api_keys = _numbered(
    "api_keys",
    sa.Column("id", sa.String, nullable=False, unique=True),
    sa.Column("name", sa.String, nullable=False),
    sa.Column(
        "digest", sa.String, nullable=False, unique=True
    ),  # SHA-256 of the secret, which is nowhere
    sa.Column("scopes", sa.String, nullable=False),  # words, with spaces between
    sa.Column("project", sa.String, nullable=False, server_default=""),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("revoked_at", sa.Float),
    sa.Column("expires_at", sa.Float),  # null: never
    sa.Column("successor", sa.String),  # id of the key that a rotation has made for it
)

projects = _table(  # those with a quota; the others exist by being named
    "projects",
    sa.Column("name", sa.String, primary_key=True),
    sa.Column("max_samples", _Wide),  # null: any number
    sa.Column("max_jobs", sa.Integer),  # null: any number
)

audit_log = _numbered(  # triggers of the migration refuse to change or to delete its rows
    "audit_log",
    sa.Column("at", sa.Float, nullable=False),
    sa.Column("actor", sa.String, nullable=False),
    sa.Column("action", sa.String, nullable=False),
    sa.Column("subject", sa.String, nullable=False),
    sa.Column("details", sa.Text, nullable=False),  # JSON
)

webhooks = _numbered(
    "webhooks",
    sa.Column("id", sa.String, nullable=False, unique=True),
    sa.Column("project", sa.String, nullable=False),
    sa.Column("url", sa.String, nullable=False),
    sa.Column("secret", sa.String, nullable=False),  # sealed (access/keys.py)
    sa.Column(
        "position", _Wide, nullable=False
    ),  # id of the last event that was delivered, or needs no delivery
    sa.Column(
        "next_at", sa.Float, nullable=False
    ),  # when to try again; ahead, while a coordinator is at it
    sa.Column("failures", sa.Integer, nullable=False),  # tries in a row that failed
    sa.Column("failing_since", sa.Float),
    sa.Column("fault", sa.Text, nullable=False),  # of the last try; empty where it went well
    sa.Column("created_at", sa.Float, nullable=False),
)

events = _table(
    "events",
    sa.Column("id", _Wide, primary_key=True),
    sa.Column("job", _Wide, sa.ForeignKey("jobs.seq"), nullable=False),
    sa.Column("name", sa.String, nullable=False),
    sa.Column("data", sa.Text, nullable=False),  # JSON
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Index("ix_events_job_id", "job", "id"),
    sqlite_autoincrement=True,
)


def schema_digest() -> str:
    """Return 12 characters that change with any table, column or index."""
    lines: list[str] = []
    for table in metadata.sorted_tables:
        for column in table.columns:
            kind = type(column.type).__name__
            lines.append(
                f"{table.name}.{column.name} {kind} {column.nullable} {column.primary_key}"
            )
        for index in sorted(table.indexes, key=lambda index: str(index.name)):
            columns = " ".join(column.name for column in index.columns)
            condition = index.dialect_options["sqlite"]["where"]
            lines.append(f"{index.name} on {columns} where {condition}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]
