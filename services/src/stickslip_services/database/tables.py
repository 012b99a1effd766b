"""The tables of the coordinator's database.

Tasks are global and keyed by content; jobs point at the tasks that they need. Inside the database a task is its `seq`
(8 bytes in five indexes, where its name would be 73); outside it is `<stage>-<key>`. Times are seconds since 1970.
"""

from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    text,
)

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)


def _partial(condition: str) -> dict[str, Any]:
    return {"sqlite_where": text(condition), "postgresql_where": text(condition)}


_Wide = BigInteger().with_variant(Integer, "sqlite")
"""64 bits: SQLite's INTEGER has them, and it must be called so to be a rowid."""


def _table(name: str, *columns: Column[Any] | Index, **options: Any) -> Table:
    return Table(name, metadata, *columns, **options)


def _numbered(name: str, *columns: Column[Any] | Index) -> Table:
    """Return a table whose rows have numbers, `seq`, none of which is given again."""
    return _table(name, Column("seq", _Wide, primary_key=True), *columns, sqlite_autoincrement=True)


def _key(name: str) -> Column[Any]:
    return Column(name, _Wide, primary_key=True, autoincrement=False)


workers = _numbered(
    "workers",
    Column("id", String, nullable=False, unique=True),
    Column("name", String, nullable=False, index=True),
    Column("builds", Text, nullable=False),  # JSON: by kind
    Column("condition", Text, nullable=False),  # JSON
    Column("versions", Text, nullable=False),  # JSON
    Column("registered_at", Float, nullable=False),
    Column("last_seen_at", Float, nullable=False),
    Column("superseded", Boolean, nullable=False),
)

jobs = _numbered(
    "jobs",
    Column("id", String, nullable=False, unique=True),
    Column("name", String),
    Column("project", String, nullable=False, server_default=""),  # of the key that it was submitted with
    Column("kind", String, nullable=False),
    Column("spec", Text, nullable=False),  # JSON
    Column("sample_count", Integer, nullable=False),
    Column("builds", Text),  # JSON; null until its planning begins
    Column("certificate", String),  # digest of its certificate when planning began
    Column("digest", _Wide, nullable=False),  # of spec, builds and certificate (queue/recompute.py)
    Column("planned", Integer, nullable=False, server_default="0"),  # number of samples whose tasks are inserted
    Column("planner", String),  # the coordinator that plans it
    Column("planner_until", Float),  # when another coordinator may go on with that
    Column("given_up", _Wide),  # the last task that was given up, while a cancelled job has more that wait
    Column("publish_task", _Wide, index=True),  # null until the job is planned
    Column("state", String, nullable=False),
    Column("reason", String),
    Column("message", Text, nullable=False),
    Column("rejected_count", Integer, nullable=False),
    Column("priority", Integer, nullable=False, server_default="0"),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("finished_at", Float),
    Column("dataset", String),
    Column("version", Integer),
    Column("manifest", String),
    Index(
        "ix_jobs_open",
        "seq",
        **_partial("state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')"),
    ),
)

idempotency_keys = _table(
    "idempotency_keys",
    Column("project", String, primary_key=True),
    Column("key", String, primary_key=True),
    Column("fingerprint", String, nullable=False),
    Column("job", _Wide, ForeignKey("jobs.seq"), nullable=False),
    Column("response", Text, nullable=False),
    Column("created_at", Float, nullable=False),
)

tasks = _table(
    "tasks",
    Column("seq", _Wide, primary_key=True),
    Column("key", LargeBinary(32), nullable=False, unique=True),
    Column("stage", String, nullable=False),
    Column("kind", String, nullable=False),
    Column("build", String, nullable=False),  # of its stage: what a worker must have to run it
    Column("payload", Text, nullable=False),  # JSON; what the task is besides the results it waits for
    Column("preview", Boolean, nullable=False),
    Column("cost_group", String, nullable=False, server_default=""),  # tasks of one group cost about the same
    Column("job", _Wide, nullable=False),  # the oldest live job that needs it, while it is pending
    Column("state", String, nullable=False),
    Column("reason", String),
    Column("message", Text, nullable=False, server_default=""),
    Column("waiting_on", Integer, nullable=False),  # dependencies that are not settled
    Column("token", Integer, nullable=False, server_default="0"),  # fencing: increments at each lease
    Column("owner", String),  # worker id, while leased or running
    Column("expires_at", Float),
    Column("attempts", Integer, nullable=False, server_default="0"),  # times that it was started
    Column("tries", Integer, nullable=False, server_default="0"),  # of these, the failed ones
    Column("losses", Integer, nullable=False, server_default="0"),  # of these, the ones that a lost worker ended
    Column("retry_at", Float),
    Column("reported_token", Integer),
    Column("reported_by", String),
    Column("output", Text),  # JSON
    Column("digest", _Wide),  # of what it made, while it is settled (queue/recompute.py)
    Column("cpu_seconds", Float),
    Column("wall_seconds", Float),
    Column("started_at", Float),
    Column("finished_at", Float),
    Index(
        "ix_tasks_ready",
        "stage",
        "build",
        "kind",
        "job",
        "seq",
        "cost_group",
        **_partial("state = 'pending' AND waiting_on = 0"),
    ),
    Index("ix_tasks_leased", "owner", **_partial("owner IS NOT NULL")),
    Index("ix_tasks_retry", "retry_at", **_partial("state = 'soft_failed'")),
)

# The bulk tables have no foreign keys: checking them would double the time of a plan, rows are only ever written by
# plan.py, and the tests check that both ends exist.

task_dependencies = _table(
    "task_dependencies",
    _key("task"),
    Column("depends_on", _Wide, primary_key=True, autoincrement=False, index=True),
    sqlite_with_rowid=False,
)

job_tasks = _table(
    "job_tasks",
    _key("job"),
    Column("task", _Wide, primary_key=True, autoincrement=False, index=True),
    Column("cached", Boolean, nullable=False),  # it was settled before the job was submitted
    sqlite_with_rowid=False,
)

samples = _table(
    "samples",
    _key("job"),
    _key("slot"),
    Column("key", LargeBinary(32), nullable=False),
    Column("simulate_task", _Wide, nullable=False),
    Column("render_task", _Wide),
    Column("split", Integer, nullable=False),
    Column("labels", Text, nullable=False),  # JSON: the point of the grid
    Column("digest", _Wide, nullable=False),  # of the other columns (queue/recompute.py)
    sqlite_with_rowid=False,
)

previews = _table("previews", _key("task"), Column("digest", String, nullable=False, index=True))

# Counters, updated by the ledger in the transaction that moves the tasks, so that showing progress counts no rows.

job_counts = _table(
    "job_counts",
    Column("job", _Wide, ForeignKey("jobs.seq"), primary_key=True, autoincrement=False),
    Column("stage", String, primary_key=True),
    Column("state", String, primary_key=True),
    Column("count", Integer, nullable=False),
)

job_stages = _table(
    "job_stages",
    Column("job", _Wide, ForeignKey("jobs.seq"), primary_key=True, autoincrement=False),
    Column("stage", String, primary_key=True),
    Column("cached", Integer, nullable=False),
    Column("cpu_seconds", Float, nullable=False, server_default="0"),
    Column("wall_count", Integer, nullable=False, server_default="0"),
    Column("wall_sum", Float, nullable=False, server_default="0"),
    Column("wall_squares", Float, nullable=False, server_default="0"),
)

task_counts = _table(
    "task_counts",
    Column("stage", String, primary_key=True),
    Column("state", String, primary_key=True),
    Column("count", Integer, nullable=False),
)

job_groups = _table(
    "job_groups",
    Column("job", _Wide, ForeignKey("jobs.seq"), primary_key=True, autoincrement=False),
    Column("stage", String, primary_key=True),
    Column("cost_group", String, primary_key=True),
    Column("left", Integer, nullable=False),  # tasks of the group that are not over
)

cost_groups = _table(
    "cost_groups",
    Column("stage", String, primary_key=True),
    Column("kind", String, primary_key=True),
    Column("cost_group", String, primary_key=True),
    Column("count", Integer, nullable=False),  # of finished tasks; halved with the sums now and then (queue/eta.py)
    Column("wall_sum", Float, nullable=False),  # of a task's share of the call that made it
    Column("wall_squares", Float, nullable=False),
    Column("call_sum", Float, nullable=False),  # of the whole call
    Column("call_squares", Float, nullable=False),
)

datasets = _numbered(
    "datasets",
    Column("id", String, nullable=False, unique=True),
    Column("name", String),
    Column("kind", String, nullable=False),
    Column("spec_digest", String, nullable=False),
)

dataset_versions = _table(
    "dataset_versions",
    Column("dataset", String, primary_key=True),
    Column("version", Integer, primary_key=True, autoincrement=False),
    Column("publish_task", _Wide, nullable=False, unique=True),
    Column("manifest", String),  # null: the number is taken, the version is not committed
    Column("group_digest", String),  # of the root's zarr.json
    Column("created_at", Float),
    Column("sample_count", Integer),
    Column("valid_count", Integer),
    Column("bytes", _Wide),
    Column("scrubbed_at", Float),  # when all its files were read last, or made
    Column("damaged", Integer, nullable=False, server_default="0"),  # files that were damaged then
)

certificates = _numbered(
    "certificates",
    Column("digest", String, nullable=False, unique=True),
    Column("artifact", String, nullable=False),  # the document
    Column("preset", String, nullable=False),
    Column("sim_core", String, nullable=False),
    Column("extent", String, nullable=False),
    Column("passed", Boolean, nullable=False),
    Column("protocols", String, nullable=False, server_default=""),  # names, with spaces between
    Column("created_at", Float, nullable=False),
    Index("ix_certificates_preset_sim_core", "preset", "sim_core"),
)

uploads = _table(  # who has uploaded which artifact
    "uploads", Column("project", String, primary_key=True), Column("digest", String, primary_key=True)
)

api_keys = _numbered(
    "api_keys",
    Column("id", String, nullable=False, unique=True),
    Column("name", String, nullable=False),
    Column("digest", String, nullable=False, unique=True),  # SHA-256 of the secret, which is nowhere
    Column("scopes", String, nullable=False),  # words, with spaces between
    Column("project", String, nullable=False, server_default=""),
    Column("created_at", Float, nullable=False),
    Column("revoked_at", Float),
)

projects = _table(  # those with a quota; the others exist by being named
    "projects",
    Column("name", String, primary_key=True),
    Column("max_samples", _Wide),  # null: any number
    Column("max_jobs", Integer),  # null: any number
)

audit_log = _numbered(  # triggers of the migration refuse to change or to delete its rows
    "audit_log",
    Column("at", Float, nullable=False),
    Column("actor", String, nullable=False),
    Column("action", String, nullable=False),
    Column("subject", String, nullable=False),
    Column("details", Text, nullable=False),  # JSON
)

webhooks = _numbered(
    "webhooks",
    Column("id", String, nullable=False, unique=True),
    Column("project", String, nullable=False),
    Column("url", String, nullable=False),
    Column("secret", String, nullable=False),  # sealed (access/keys.py)
    Column("position", _Wide, nullable=False),  # id of the last event that was delivered, or needs no delivery
    Column("next_at", Float, nullable=False),  # when to try again; ahead, while a coordinator is at it
    Column("failures", Integer, nullable=False),  # tries in a row that failed
    Column("failing_since", Float),
    Column("fault", Text, nullable=False),  # of the last try; empty where it went well
    Column("created_at", Float, nullable=False),
)

events = _table(
    "events",
    Column("id", _Wide, primary_key=True),
    Column("job", _Wide, ForeignKey("jobs.seq"), nullable=False),
    Column("name", String, nullable=False),
    Column("data", Text, nullable=False),  # JSON
    Column("created_at", Float, nullable=False),
    Index("ix_events_job_id", "job", "id"),
    sqlite_autoincrement=True,
)
