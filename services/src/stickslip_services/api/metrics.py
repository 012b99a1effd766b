"""Metrics for Prometheus: the queue, read from its counters when somebody asks, and the requests."""

from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import Connection, func, select

from stickslip_services.database.database import Database
from stickslip_services.database.tables import jobs, task_counts
from stickslip_services.queue.workers import RegisteredWorker, leased_counts

EtaHeld = Mapping[tuple[str, bool], int]
AliveWorkers = Callable[[Connection], list[RegisteredWorker]]


class _QueueCollector(Collector):
    def __init__(self, database: Database, alive_workers: AliveWorkers, eta_held: EtaHeld) -> None:
        self._database = database
        self._alive_workers = alive_workers
        self._eta_held = eta_held

    def collect(self) -> Iterable[Metric]:
        tasks = GaugeMetricFamily("stickslip_tasks", "Tasks by stage and state", labels=["stage", "state"])
        by_state = GaugeMetricFamily("stickslip_jobs", "Jobs by state", labels=["state"])
        leases = GaugeMetricFamily("stickslip_leases", "Tasks on lease by worker", labels=["worker"])
        workers = GaugeMetricFamily("stickslip_workers", "Workers that were heard of lately")
        slots = GaugeMetricFamily("stickslip_worker_slots", "Slots of the workers that were heard of lately")
        with self._database.read() as connection:
            alive = self._alive_workers(connection)
            for stage, state, count in connection.execute(select(task_counts)):
                tasks.add_metric([stage, state], count)
            for state, count in connection.execute(select(jobs.c.state, func.count()).group_by(jobs.c.state)):
                by_state.add_metric([state], count)
            held = leased_counts(connection)
        for worker in alive:
            leases.add_metric([worker.name], held.get(worker.id, 0))
        workers.add_metric([], len(alive))
        slots.add_metric([], sum(worker.slots for worker in alive))
        etas = CounterMetricFamily(
            "stickslip_eta_predictions",
            "Intervals of the time left that were noted every 5 s, by whether the job ended within; 80 % should hold",
            labels=["kind", "held"],
        )
        for (kind, held_true), count in self._eta_held.items():
            etas.add_metric([kind, str(held_true).lower()], count)
        return [tasks, by_state, leases, workers, slots, etas]


class Metrics:
    """The metrics of one coordinator."""

    def __init__(self, database: Database, alive_workers: AliveWorkers, eta_held: EtaHeld) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(_QueueCollector(database, alive_workers, eta_held))
        self._requests = Histogram(
            "stickslip_request_seconds",
            "Time to answer a request [s]",
            ["method", "route", "status"],
            registry=self._registry,
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Note that a request was answered."""
        self._requests.labels(method, route, str(status)).observe(seconds)

    def text(self) -> bytes:
        """Return all metrics as Prometheus reads them."""
        return generate_latest(self._registry)
