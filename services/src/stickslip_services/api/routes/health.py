"""Health checks, and Prometheus metrics.

The queue and the store are read at each scrape; counters count since the start.
"""

from collections import Counter as Counts
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fastapi import APIRouter, Request, Response
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Histogram,
    Info,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import Connection, func, select, text
from stickslip_schemas.base import Document
from stickslip_schemas.documents.worker_api import ReportAnswer, ReportBatch
from stickslip_schemas.store import DirectoryStore, Store

from stickslip_services import __version__
from stickslip_services.access.keys import keys_that_expire
from stickslip_services.access.principals import refuse_projects
from stickslip_services.api.routes.common import ContextDep, StrictRoute, problem_responses
from stickslip_services.database.tables import dataset_versions, jobs
from stickslip_services.database.tables import tasks as tasks_
from stickslip_services.queue.context import Context
from stickslip_services.queue.rows import IS_LEASED
from stickslip_services.queue.totals import count_tasks
from stickslip_services.queue.watch import MAX_IDLE_JOBS, idle_jobs, silent_workers
from stickslip_services.queue.workers import alive_workers


class _Versions(NamedTuple):
    """All complete dataset versions together."""

    number: int
    size: int | None
    damaged: int | None
    scrubbed_at: float | None


class _QueueCollector(Collector):
    def __init__(self, context: Context) -> None:
        self._context = context

    def collect(self) -> Iterable[Metric]:
        # One read transaction: all metrics of a scrape show the same moment.
        with self._context.database.read() as connection:
            now = self._context.clock()
            return [
                *self._queue_metrics(connection),
                *self._worker_metrics(connection, now),
                *self._store_metrics(connection, now),
                *_warning_metrics(connection, now),
            ]

    def _queue_metrics(self, connection: Connection) -> Iterator[Metric]:
        tasks = [(*key, count) for key, count in count_tasks(connection).items()]
        yield _gauge("tasks", "Tasks of jobs by stage and state", tasks, "stage", "state")
        states = select(jobs.c.state, func.count()).group_by(jobs.c.state)
        yield _gauge("jobs", "Jobs by state", connection.execute(states).all(), "state")

    def _worker_metrics(self, connection: Connection, now: float) -> Iterator[Metric]:
        alive = alive_workers(self._context, connection)
        leases = Counts(connection.scalars(select(tasks_.c.owner).where(IS_LEASED)).all())
        by_worker = [(worker.name, leases[worker.id]) for worker in alive]
        yield _gauge("leases", "Tasks on lease by worker", by_worker, "worker")
        yield _gauge("workers", "Workers with a recent message", [(len(alive),)])
        slots = sum(worker.condition.slots for worker in alive)
        yield _gauge("worker_slots", "Slots of workers with a recent message", [(slots,)])
        yield _gauge(
            "worker_silent_seconds",
            "Time since the last message of workers that were not stopped [s]",
            silent_workers(connection, now),
            "worker",
        )

    def _store_metrics(self, connection: Connection, now: float) -> Iterator[Metric]:
        columns = dataset_versions.c
        sums = (
            func.count(),
            func.sum(columns.bytes),
            func.sum(columns.damaged),
            func.min(columns.scrubbed_at),
        )
        complete = select(*sums).where(columns.manifest.is_not(None))
        versions = _Versions(*connection.execute(complete).one())
        yield _gauge("dataset_versions", "Dataset versions", [(versions.number,)])
        size = versions.size or 0
        yield _gauge("dataset_bytes", "Size of the files of all dataset versions", [(size,)])
        damaged = versions.damaged or 0
        yield _gauge("damaged_files", "Files that scrubbing found damaged", [(damaged,)])
        # Without a version there is nothing to scrub.
        age = 0.0 if versions.scrubbed_at is None else now - versions.scrubbed_at
        yield _gauge("unread_seconds", "Age of the oldest scrub of a version [s]", [(age,)])
        yield _gauge("disk_bytes", "Disks of store and database", self._disks(), "place", "state")
        yield _gauge(
            "store_unavailable",
            "Whether store or database take no results, and jobs are paused",
            [(float(bool(self._context.store_watch.trouble)),)],
        )

    def _disks(self) -> list[tuple[str, str, float]]:
        """Return the free and used bytes of each disk, once if store and database share one."""
        data = self._context.settings.data
        places: dict[str, Store] = {"store": self._context.store}
        store_directory = self._context.store.cache
        if store_directory is None or not _on_one_disk(store_directory, data):
            places["data"] = DirectoryStore(data)
        rows: list[tuple[str, str, float]] = []
        for name, place in places.items():
            usage = place.disk_usage()
            # A bucket has no limit that it knows.
            if usage is not None:
                rows += [(name, "free", usage.free), (name, "used", usage.used)]
        return rows


def _warning_metrics(connection: Connection, now: float) -> Iterator[Metric]:
    """Yield the times after which somebody should look at a job or at a key."""
    yield _gauge(
        "job_idle_seconds",
        f"Time since the last progress of the {MAX_IDLE_JOBS} most idle active jobs [s]",
        idle_jobs(connection, now),
        "job_id",
    )
    expiring = keys_that_expire(connection, now)
    yield _gauge(
        "key_seconds",
        "Time until a key without a successor expires [s]",
        [(key.id, key.name, key.expires_at - now) for key in expiring],
        "key",
        "name",
    )


def _on_one_disk(store: Path, data: Path) -> bool:
    # The first artifact makes the directory of the store.
    while not store.exists():
        store = store.parent
    return store.stat().st_dev == data.stat().st_dev


def _gauge(name: str, text: str, rows: Iterable[Sequence[Any]], *labels: str) -> Metric:
    """Return a gauge from rows with the values of its labels, and its value last."""
    gauge = GaugeMetricFamily(f"stickslip_{name}", text, labels=labels)
    for *label_values, value in rows:
        gauge.add_metric(label_values, value)
    return gauge


class Metrics:
    """The metrics of a coordinator."""

    def __init__(self, context: Context) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(_QueueCollector(context))
        Info("stickslip", "The coordinator", registry=self._registry).info({"version": __version__})
        self._task_seconds = Histogram(
            "stickslip_task_seconds",
            "Time that a try of a task took, by how it ended [s]",
            ["stage", "outcome"],
            registry=self._registry,
            buckets=(0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000, 3000, 10000),
        )
        self._failures = Counter(
            "stickslip_task_failures",
            "Tries that failed and samples that were rejected, by reason",
            ["stage", "outcome", "reason"],
            registry=self._registry,
        )
        self._requests = Histogram(
            "stickslip_request_seconds",
            "Time to answer a request [s]",
            ["method", "route", "status"],
            registry=self._registry,
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        self._requests.labels(method, route, str(status)).observe(seconds)

    def count_reports(self, batch: ReportBatch, answer: ReportAnswer) -> None:
        # A report that was refused, or accepted before, measures nothing new.
        for report, verdict in zip(batch.reports, answer.verdicts, strict=True):
            result = report.result
            if verdict.verdict != "accepted" or result is None:
                continue
            stage = report.task_id.partition("-")[0]
            self._task_seconds.labels(stage, result.outcome).observe(result.wall_seconds)
            if result.reason is not None:
                self._failures.labels(stage, result.outcome, result.reason).inc()

    def text(self) -> bytes:
        return generate_latest(self._registry)


router = APIRouter()
strict = APIRouter(route_class=StrictRoute)


class Health(Document):
    """The coordinator answers."""

    version: str


@router.get("/livez")
async def get_livez() -> Health:
    """Answer: the process is alive."""
    return Health(version=__version__)


@router.get("/readyz", responses=problem_responses())
def get_readyz(context: ContextDep) -> Health:
    """Answer: the database can be read. 503 where it cannot."""
    with context.database.read() as connection:
        connection.execute(text("SELECT seq FROM jobs LIMIT 1"))
    return Health(version=__version__)


@strict.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {"description": "Metrics", "content": {"text/plain": {"schema": {"type": "string"}}}},
        **problem_responses(404),
    },
)
def get_metrics(request: Request) -> Response:
    """Return metrics for Prometheus. 404: the key belongs to a project."""
    refuse_projects("metrics")
    metrics: Metrics = request.app.state.metrics
    return Response(metrics.text(), headers={"Content-Type": CONTENT_TYPE_LATEST})


# Probes add parameters of their own against caches; they are the only requests that may.
router.routes += strict.routes
