"""CPU time of each verb of the queue, in this checkout or beside another one.

    python benchmarks/queue_verbs.py one --samples 496000 --advance 128000
    python benchmarks/queue_verbs.py shared --samples 200000 [--database URL]
    python benchmarks/queue_verbs.py one --samples 496000 --beside OTHER [--beside-database URL]

`one`: one job. Leases and reports of 64, heartbeats with 64 leases, progress, pause, resume,
priority, and cancel with all that follows. With `--advance`, so many simulations run without being
measured, and then the same is measured again. `shared`: 20 jobs of 20 projects that share half of
their tasks, and how many tasks each project is leased. In both, a small job leases tasks while the
first job is paused, resumed, prioritised and cancelled, which shows how long others wait.

The functions of the coordinator are called without HTTP. Composition of documents and checks of the
store are left out. Prints one JSON object: CPU ms of the calling thread as median and 99th
percentile, and waits in ms of wall time. Databases of URLs are empty.

`--beside` names the root of another checkout. Each has a process of its own, and they take turns of
a few calls, so other load on the machine meets both alike. Only the code of `services`, `schemas`
and `testing` differs; the interpreter and its packages are the same.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import sqlalchemy as sa
import stickslip_services
from stickslip_schemas.documents.tasks import (
    ChunkRef,
    RecordRef,
    RenderOutput,
    SimulateOutput,
    TaskResult,
)
from stickslip_services.queue import control
from stickslip_services.queue import lease as lease_module
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import show_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import parsed
from stickslip_testing.worker import DirectApi, PretendWorker

ROOT = Path(__file__).parents[1]

PROJECTS = 20

BATCH = 64
"""Tasks of a lease, of a report and of a heartbeat."""

LARGE_BATCH = 512
"""Tasks of a lease and of a report that are not measured."""

LEASES_HELD = 40
"""Leases that are taken before the first is reported, to see how they spread over the projects."""

PIECES_A_TURN = 4
"""Pieces of a plan that one checkout plans before the other's turn."""

CONTROLS = 9
"""Repetitions of pause, resume and the like: the first call compiles its statements."""

SETTLING_SECONDS = 0.5
"""Time in which others lease before and after a job is controlled [s]."""

SMALL_JOB_SAMPLES = 5000

RESULTS = {
    "simulate": SimulateOutput(record=RecordRef(digest="d" * 64, row=0), labels={"energy": 0.5}),
    "render": RenderOutput(
        chunks={"views": ChunkRef(digest="e" * 64, offset=0, length=1000)}, labels={}
    ),
}


# ---- The queue of the installed code -------------------------------------------------------------


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
        self.composing = defaultdict[int, float](float)
        """CPU time of the composition of documents, by thread [s]."""
        self.prefix = ""

    def run(self, name: str, call: Callable[[], Any]) -> Any:
        """Call a function; composition of documents is not counted."""
        thread = threading.get_ident()
        composed = self.composing[thread]
        begin = time.thread_time()
        value = call()
        seconds = time.thread_time() - begin - (self.composing[thread] - composed)
        self.times.setdefault(self.prefix + name, []).append(1e3 * seconds)
        return value

    def summary(self) -> dict[str, dict[str, float]]:
        """Return a summary of the times of each name."""
        return {name: summarise(times) for name, times in self.times.items()}


def summarise(times: list[float]) -> dict[str, float]:
    """Return number, median, 99th percentile, maximum and sum of times."""
    ordered = sorted(times)
    return {
        "n": len(times),
        "median": round(statistics.median(times), 2),
        "p99": round(ordered[int(0.99 * (len(times) - 1))], 2),
        "max": round(ordered[-1], 2),
        "sum": round(sum(times), 1),
    }


class Queue:
    """The queue of the installed code, with one worker."""

    def __init__(self, data: Path, database: str | None, meter: Meter) -> None:
        self.meter = meter
        self.context = Context.open(Settings.chosen(data=data, database=database))
        find("start", "background", "control")(self.context)
        self._sweep = find("sweep", "background", "control")
        self._planner = find("Planner", "planner", "submit")(self.context)
        self._api = DirectApi(self.context)
        self.worker = self.new_worker("pretend")
        self._leave_out_composition()
        results = import_module(f"stickslip_services.queue.{_first('results', 'report')}")
        check = "_check_in_store" if hasattr(results, "_check_in_store") else "_checked_in_store"
        setattr(results, check, lambda _context, report, _versions: report)

    def new_worker(self, name: str) -> PretendWorker:
        """Register a worker."""
        return PretendWorker(self._api, self.context.store, name=name).register()

    def _leave_out_composition(self) -> None:
        compose = lease_module._compose_leases

        def timed(*arguments: Any) -> Any:
            begin = time.thread_time()
            value = compose(*arguments)
            self.meter.composing[threading.get_ident()] += time.thread_time() - begin
            return value

        # Each checkout has its own signature.
        vars(lease_module)["_compose_leases"] = timed

    def submit(self, spec: dict[str, Any], project: str) -> str:
        """Submit a job of a project."""
        job = submit_job(self.context, parsed(spec)).id  # type: ignore[union-attr]
        with self.context.database.write() as connection:
            of_project = sa.text("UPDATE jobs SET project = :project WHERE id = :job")
            connection.execute(of_project, {"project": project, "job": job})
        return job

    def plan_pieces(self) -> bool:
        """Plan some pieces, and return whether more may be left."""
        return all(self._planner.step() for _ in range(PIECES_A_TURN))

    def lease(self, stage: str = "simulate", count: int = BATCH) -> Any:
        """Lease tasks of a stage."""
        return self.worker.lease(**{stage: count})

    def report(self, leases: Any) -> None:
        """Report results of leases."""
        reports: list[tuple[Any, TaskResult]] = []
        for lease in leases:
            output = RESULTS[lease.task.stage]
            seconds = {"cpu_seconds": 2.0, "wall_seconds": 1.0, "call_seconds": 1.0}
            reports.append((lease, TaskResult(outcome="succeeded", output=output, **seconds)))
        assert set(self.worker.report(*reports)) == {"accepted"}

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

    def empty(self) -> None:
        """Remove ended jobs from the queue, in pieces with pauses, as the coordinator does."""
        try:
            leaving = import_module("stickslip_services.queue.leaving")
        except ImportError:  # an earlier checkout, which leaves the rows there
            return
        cleaner = leaving.QueueCleaner(self.context)
        while self.meter.run("a piece of the queue of a cancelled job", cleaner.step):
            time.sleep(leaving.REST_SECONDS)

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


# ---- What is measured ----------------------------------------------------------------------------


def spec_of(samples: int, number: int | None = None) -> dict[str, Any]:
    """Return rods; with a number, the first half of the samples is the same for all numbers."""
    ten = {"type": "linspace", "start": 0.0, "stop": 10.0, "num": 10}
    count = samples // 100
    gamma = [1.0 + 0.01 * index for index in range(count)]
    if number is not None:
        start = 1000.0 * (1 + number)
        gamma[count // 2 :] = [start + 0.01 * index for index in range(count - count // 2)]
    return {"kind": "rod_hang", "axes": {"gamma": gamma, "phi0": ten, "phi1": ten}}


def measure(options: argparse.Namespace, result: dict[str, Any]) -> Iterator[None]:
    """Measure, and fill `result`; yield wherever the other checkout may take its turn."""
    meter = Meter()
    with tempfile.TemporaryDirectory() as directory:
        queue = Queue(Path(directory), options.database, meter)
        jobs: list[str] = []
        for number, spec in enumerate(_specs(options)):
            jobs.append(queue.submit(spec, f"project-{number:02}"))
            yield from _plan(queue, "plan a job")
        with queue.context.database.read() as connection:
            result["tasks"] = connection.scalar(sa.text("SELECT count(*) FROM tasks"))
        if options.scenario == "shared":
            held = [queue.lease() for _ in range(LEASES_HELD)]
            result["leased_by_project"] = queue.leased_by_project()
            for leases in held:
                queue.report(leases)
            yield
        yield from _run_cycles(queue, options.cycles)
        if options.advance:
            yield from _advance(queue, options.advance)
            meter.prefix = "later: "
            yield from _run_cycles(queue, options.cycles)
            meter.prefix = ""
        yield from _control_jobs(queue, jobs[:3])
        queue.submit(spec_of(SMALL_JOB_SAMPLES, PROJECTS), "project-of-another")
        yield from _plan(queue, "plan a small job")
        yield from _watch_waits(queue, jobs[0], result)
        queue.context.close()
        file = Path(directory) / "coordinator.sqlite3"
        if file.exists():
            result["database_mb"] = round(file.stat().st_size / 1e6, 1)
    result["peak_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
    result["cpu_ms"] = meter.summary()


def _specs(options: argparse.Namespace) -> list[dict[str, Any]]:
    if options.scenario == "one":
        return [spec_of(options.samples)]
    each = options.samples // PROJECTS // 100 * 100
    return [spec_of(each, number) for number in range(PROJECTS)]


def _plan(queue: Queue, name: str) -> Iterator[None]:
    """Plan the submitted jobs, and add up what it costs."""
    begin = time.thread_time()
    spent = 0.0
    while queue.plan_pieces():
        spent += time.thread_time() - begin
        yield
        begin = time.thread_time()
    spent += time.thread_time() - begin
    queue.meter.times.setdefault(name, []).append(1e3 * spent)


def _run_cycles(queue: Queue, count: int) -> Iterator[None]:
    """Lease and report, with a heartbeat now and then."""
    meter = queue.meter
    for number in range(count):
        for stage in ("simulate", "render"):
            leases = meter.run(f"lease of 64, {stage}", partial(queue.lease, stage))
            assert len(leases) == BATCH
            if number % 4 == 0:
                assert not meter.run("heartbeat of 64", partial(queue.worker.beat, *leases))
            meter.run(f"report of 64, {stage}", partial(queue.report, leases))
        yield


def _advance(queue: Queue, count: int) -> Iterator[None]:
    """Run simulations and their renders without measuring."""
    for _ in range(count // LARGE_BATCH):
        for stage in ("simulate", "render"):
            queue.report(queue.lease(stage, LARGE_BATCH))
        yield
    # PostgreSQL does this by itself, at a time that would meet one checkout only.
    queue.context.database.analyse()


def _control_jobs(queue: Queue, jobs: list[str]) -> Iterator[None]:
    """Show, pause, resume and prioritise jobs."""
    context = queue.context
    for job in jobs:
        for _ in range(CONTROLS):
            queue.meter.run("progress", partial(queue.progress, job))
            queue.meter.run("pause", partial(control.pause_job, context, job))
            queue.meter.run("resume", partial(control.resume_job, context, job))
            queue.meter.run("priority", partial(control.prioritise_job, context, job, 3))
            yield


def _watch_waits(queue: Queue, job: str, result: dict[str, Any]) -> Iterator[None]:
    """Control and cancel a job while others lease, and note how long they wait."""
    context = queue.context
    verbs: dict[str, Callable[[], Any]] = {
        "nothing": lambda: None,
        "pause": partial(control.pause_job, context, job),
        "resume": partial(control.resume_job, context, job),
        "priority": partial(control.prioritise_job, context, job, 5),
        "cancel": partial(queue.meter.run, "cancel, the call", lambda: _cancel(context, job)),
        "what follows": partial(
            queue.meter.run, "cancel, all that follows", partial(queue.finish_cancel, job)
        ),
        "removal from the queue": queue.empty,
    }
    waits: dict[str, dict[str, float]] = {}
    for verb, call in verbs.items():
        with Competitor(queue) as competitor:
            time.sleep(SETTLING_SECONDS)
            begin = time.perf_counter()
            call()
            wall = 1e3 * (time.perf_counter() - begin)
            time.sleep(SETTLING_SECONDS)
        waits[verb] = {"call": round(wall, 1), **summarise(competitor.waits)}
        yield
    result["waits_ms"] = waits


def _cancel(context: Context, job: str) -> None:
    control.cancel_job(context, job)


class Competitor:
    """A worker in a thread, which leases tasks and gives them back."""

    def __init__(self, queue: Queue) -> None:
        self.waits: list[float] = []
        self._worker = queue.new_worker("other")
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "Competitor":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ends.wait(0.01):
            begin = time.perf_counter()
            leases = self._worker.lease(simulate=8)
            self.waits.append(1e3 * (time.perf_counter() - begin))
            self._worker.report(*((lease, None) for lease in leases))


# ---- Turns ---------------------------------------------------------------------------------------


def commit_of(checkout: Path) -> str:
    """Return the commit of a checkout."""
    command = ["git", "-C", str(checkout), "rev-parse", "--short=12", "HEAD"]
    return subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout.strip()


def take_turns(options: argparse.Namespace) -> None:
    """Measure in this process; a line of the standard input begins each turn."""
    result: dict[str, Any] = {}
    turns = measure(options, result)
    for _ in sys.stdin:
        has_ended = next(turns, True)
        print(json.dumps(result if has_ended else None), flush=True)
        if has_ended:
            return


class Checkout:
    """A process that measures the code of a checkout, turn by turn."""

    def __init__(self, root: Path, database: str | None, options: argparse.Namespace) -> None:
        self.commit = commit_of(root)
        self.result: dict[str, Any] | None = None
        folders = ("services/src", "schemas/src", "testing/src")
        path = os.pathsep.join(str(root / folder) for folder in folders)
        self._process = subprocess.Popen(
            [sys.executable, __file__, *arguments_of(options, database), "--turns"],
            env=os.environ | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def take_turn(self) -> None:
        """Let the process take a turn, and wait for its end."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"the process of commit {self.commit} has died")
        self.result = json.loads(line)


def arguments_of(options: argparse.Namespace, database: str | None) -> list[str]:
    """Return the arguments of the process of one checkout."""
    numbers = {name: getattr(options, name) for name in ("samples", "cycles", "advance")}
    arguments = [options.scenario]
    for name, number in numbers.items():
        arguments += [f"--{name}", str(number)]
    if database is not None:
        arguments += ["--database", database]
    return arguments


def compare(options: argparse.Namespace) -> dict[str, Any]:
    """Let both checkouts measure in turns, the other one first."""
    beside = Checkout(options.beside, options.beside_database, options)
    this = Checkout(ROOT, options.database, options)
    while beside.result is None or this.result is None:
        for checkout in (beside, this):
            if checkout.result is None:
                checkout.take_turn()
    results = {checkout.commit: checkout.result for checkout in (beside, this)}
    return {"ratios": ratios(beside.result["cpu_ms"], this.result["cpu_ms"]), **results}


def ratios(before: dict[str, Any], after: dict[str, Any]) -> dict[str, float]:
    """Return how many times the median before the median after is, for each name."""
    return {
        name: round(after[name]["median"] / before[name]["median"], 3)
        for name in after
        if name in before and before[name]["median"] > 0
    }


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario", choices=("one", "shared"))
    parser.add_argument("--samples", type=int, default=20_000, help="samples of all jobs")
    parser.add_argument("--cycles", type=int, default=60, help="measured cycles of leases")
    parser.add_argument("--advance", type=int, default=0, help="simulations that run in between")
    parser.add_argument("--database", help="URL of an empty PostgreSQL database")
    parser.add_argument("--beside", type=Path, help="root of another checkout")
    parser.add_argument("--beside-database", help="URL of an empty database for it")
    parser.add_argument("--turns", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.turns:
        take_turns(options)
        return
    conditions = {
        "scenario": options.scenario,
        "samples": options.samples,
        "load": round(os.getloadavg()[0], 1),
    }
    if options.beside is not None:
        result = compare(options)
    else:
        result = {"commit": commit_of(ROOT)}
        for _ in measure(options, result):
            pass
    print(json.dumps(conditions | result, indent=1))


if __name__ == "__main__":
    main()
