"""CPU time of each verb of the queue, in this checkout or in another one.

    python benchmarks/queue_verbs.py one --samples 100000 [--database postgresql://...]
    python benchmarks/queue_verbs.py shared --samples 52000
    OTHER/.venv/bin/python benchmarks/queue_verbs.py one --samples 100000

`one`: one job. Leases and reports of 64, heartbeats with 64 leases, progress, pause, resume,
priority, and cancel with all that follows. `shared`: 20 jobs of 20 projects that share half of
their tasks, and how many tasks each project is leased.

The functions of the coordinator are called without HTTP. Composition of documents and checks of the
store are left out. To compare two checkouts, run both one after the other with the same arguments,
each with its own interpreter: only the installed code differs. Prints one JSON object, times in CPU
ms of the process as median and 99th percentile. `--database` is empty.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import sqlalchemy as sa
import stickslip_services
from stickslip_schemas.documents.tasks import RecordRef, SimulateOutput, TaskResult
from stickslip_services.queue import control
from stickslip_services.queue import lease as lease_module
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import show_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import parsed
from stickslip_testing.worker import DirectApi, PretendWorker

PROJECTS = 20
BATCH = 64
"""Tasks of a lease, of a report and of a heartbeat."""

LEASES_HELD = 40
"""Leases that are taken before the first is reported, to see how they spread over the projects."""

OUTPUT = SimulateOutput(record=RecordRef(digest="d" * 64, row=0), labels={"energy": 0.5})
RESULT = TaskResult(
    outcome="succeeded", output=OUTPUT, cpu_seconds=2.0, wall_seconds=1.0, call_seconds=1.0
)


def find(name: str, *modules: str) -> Any:
    """Return a function of the first module that has it: checkouts differ in their layout."""
    for module in modules:
        try:
            return getattr(import_module(f"stickslip_services.queue.{module}"), name)
        except (ImportError, AttributeError):
            continue
    raise SystemExit(f"no module of {modules} has {name}")


class Meter:
    """CPU times of calls by name [ms]."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}
        self.composing = 0.0

    def run(self, name: str, call: Callable[[], Any]) -> Any:
        """Call a function; composition of documents is not counted."""
        composed = self.composing
        begin = time.process_time()
        value = call()
        seconds = time.process_time() - begin - (self.composing - composed)
        self.times.setdefault(name, []).append(1e3 * seconds)
        return value

    def summary(self) -> dict[str, dict[str, float]]:
        """Return number, median, 99th percentile and sum of the times of each name."""
        rows: dict[str, dict[str, float]] = {}
        for name, times in self.times.items():
            ordered = sorted(times)
            rows[name] = {
                "n": len(times),
                "median": round(statistics.median(times), 2),
                "p99": round(ordered[int(0.99 * (len(times) - 1))], 2),
                "sum": round(sum(times), 1),
            }
        return rows


class Queue:
    """The queue of the installed code, with one worker."""

    def __init__(self, data: Path, database: str | None, meter: Meter) -> None:
        self.meter = meter
        self.context = Context.open(Settings.chosen(data=data, database=database))
        find("start", "background", "control")(self.context)
        self._sweep = find("sweep", "background", "control")
        self._planner = find("Planner", "planner", "submit")(self.context)
        api = DirectApi(self.context)
        self.worker = PretendWorker(api, self.context.store).register()
        self._leave_out_composition()
        results = import_module(f"stickslip_services.queue.{_first('results', 'report')}")
        check = "_check_in_store" if hasattr(results, "_check_in_store") else "_checked_in_store"
        setattr(results, check, lambda _context, report, _versions: report)

    def _leave_out_composition(self) -> None:
        compose = lease_module._compose_leases

        def timed(*arguments: Any) -> Any:
            begin = time.process_time()
            value = compose(*arguments)
            self.meter.composing += time.process_time() - begin
            return value

        # Each checkout has its own signature.
        vars(lease_module)["_compose_leases"] = timed

    def plan(self, spec: dict[str, Any], project: str) -> str:
        """Submit and plan a job of a project."""
        job = submit_job(self.context, parsed(spec)).id  # type: ignore[union-attr]
        with self.context.database.write() as connection:
            own = sa.text("UPDATE jobs SET project = :project WHERE id = :job")
            connection.execute(own, {"project": project, "job": job})
        self._planner.run()
        return job

    def lease(self) -> Any:
        """Lease simulations."""
        return self.worker.lease(simulate=BATCH)

    def report(self, leases: Any) -> None:
        """Report results of leases."""
        verdicts = self.worker.report(*((lease, RESULT) for lease in leases))
        assert set(verdicts) == {"accepted"}

    def progress(self, job: str) -> Any:
        """Return the progress of a job."""
        with self.context.database.read() as connection:
            seq = connection.scalar(sa.text("SELECT seq FROM jobs WHERE id = :job"), {"job": job})
            return show_job(self.context, connection, seq).progress

    def finish_cancel(self, job: str) -> None:
        """Do what follows a cancellation, until the job is cancelled and nothing is left to do."""
        for release in ("give_up_waiting", "release_ended_jobs"):  # of earlier checkouts
            if hasattr(control, release):
                getattr(control, release)(self.context)
        self._sweep(self.context)
        with self.context.database.read() as connection:
            state = sa.text("SELECT state FROM jobs WHERE id = :job")
            assert connection.scalar(state, {"job": job}) == "cancelled"

    def leased_by_project(self) -> list[int]:
        """Return the numbers of tasks on lease of the projects, by the job each is leased for."""
        with self.context.database.read() as connection:
            columns = {column["name"] for column in sa.inspect(connection).get_columns("tasks")}
            job = "leased_for" if "leased_for" in columns else "job"
            query = (
                f"SELECT count(*) FROM tasks JOIN jobs ON jobs.seq = tasks.{job} "
                "WHERE tasks.owner IS NOT NULL GROUP BY jobs.project ORDER BY 1"
            )
            return list(connection.scalars(sa.text(query)))


def _first(*modules: str) -> str:
    """Return the first module of the queue that there is."""
    folder = Path(stickslip_services.__file__).parent / "queue"
    return next(module for module in modules if (folder / f"{module}.py").exists())


def spec_of(samples: int, number: int | None = None) -> dict[str, Any]:
    """Return rods; with a number, the first half of the samples is the same for all numbers."""
    ten = {"type": "linspace", "start": 0.0, "stop": 10.0, "num": 10}
    count = samples // 100
    gamma = [1.0 + 0.01 * index for index in range(count)]
    if number is not None:
        own = [1000.0 * (1 + number) + 0.01 * index for index in range(count - count // 2)]
        gamma = [*gamma[: count // 2], *own]
    return {"kind": "rod_hang", "axes": {"gamma": gamma, "phi0": ten, "phi1": ten}}


def run_cycles(queue: Queue, meter: Meter, count: int) -> None:
    """Lease and report, with a heartbeat now and then."""
    for number in range(count):
        leases = meter.run("lease of 64", queue.lease)
        assert len(leases) == BATCH
        if number % 4 == 0:
            assert not meter.run("heartbeat of 64", partial(queue.worker.beat, *leases))
        meter.run("report of 64", partial(queue.report, leases))


def control_jobs(queue: Queue, meter: Meter, jobs: list[str]) -> None:
    """Show, pause, resume and prioritise jobs, and cancel the first."""
    context = queue.context
    for job in jobs:
        # The first call compiles its statements, so one call alone says little.
        for _ in range(9):
            meter.run("progress", partial(queue.progress, job))
            meter.run("pause", partial(control.pause_job, context, job))
            meter.run("resume", partial(control.resume_job, context, job))
            meter.run("priority", partial(control.prioritise_job, context, job, 3))
    begin = time.perf_counter()
    meter.run("cancel, the call", partial(control.cancel_job, context, jobs[0]))
    meter.run("cancel, all that follows", partial(queue.finish_cancel, jobs[0]))
    meter.times["cancel until it is done, wall"] = [1e3 * (time.perf_counter() - begin)]


def commit_of(checkout: Path) -> str:
    """Return the commit of a checkout."""
    command = ["git", "-C", str(checkout), "rev-parse", "--short=12", "HEAD"]
    return subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout.strip()


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", choices=("one", "shared"))
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--cycles", type=int, default=60)
    parser.add_argument("--database", help="URL of an empty PostgreSQL database")
    options = parser.parse_args()
    meter = Meter()
    result: dict[str, Any] = {
        "commit": commit_of(Path(stickslip_services.__file__).parent),
        "scenario": options.scenario,
        "samples": options.samples,
        "load": round(os.getloadavg()[0], 1),
    }
    with tempfile.TemporaryDirectory() as directory:
        queue = Queue(Path(directory), options.database, meter)
        specs = [spec_of(options.samples)]
        if options.scenario == "shared":
            each = options.samples // PROJECTS // 100 * 100
            specs = [spec_of(each, number) for number in range(PROJECTS)]
        jobs: list[str] = []
        for number, spec in enumerate(specs):
            project = f"project-{number:02}"
            jobs.append(meter.run("plan a job", partial(queue.plan, spec, project)))
        with queue.context.database.read() as connection:
            result["tasks"] = connection.scalar(sa.text("SELECT count(*) FROM tasks"))
        if options.scenario == "shared":
            held = [queue.lease() for _ in range(LEASES_HELD)]
            result["leased_by_project"] = queue.leased_by_project()
            for leases in held:
                queue.report(leases)
        run_cycles(queue, meter, options.cycles)
        control_jobs(queue, meter, jobs[:3])
        queue.context.close()
        file = Path(directory) / "coordinator.sqlite3"
        if file.exists():
            result["database_mb"] = round(file.stat().st_size / 1e6, 1)
    result["peak_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
    result["cpu_ms"] = meter.summary()
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
