"""A job of a million samples, with workers that only pretend: what the service itself costs.

    python benchmarks/million.py plan [--samples 1000000] [--database postgresql://...]
    python benchmarks/million.py publish [--samples 1000000] [--delay 0.025]

`plan`: how long the answer to the submission takes; then, while the coordinator plans, how long
leases of another job take, and what planning costs it; then the same while the job is cancelled.
`--database` is empty.

`publish`: a planned job of which every task but the last is said to have ended, in a store that
answers each request after `--delay` seconds, whatever it asks. How long the coordinator takes to
compose the last task, a worker to publish, and the coordinator to check what the worker says; then,
in the directory of the version and without the delay, how long the reader of the training package
takes to open it, to list the samples of a split, and to filter them by a label. Each of the three
is a process of its own, with its own peak of memory. Prints one JSON object.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from plan import coordinator, peak_megabytes, spec
from sqlalchemy import Row, text
from stickslip_schemas.documents.tasks import (
    PackOutput,
    PublishTask,
    RecordRef,
    SimulateOutput,
    TaskResult,
)
from stickslip_schemas.format.codecs import encode_chunk, encode_shard
from stickslip_schemas.format.manifest import FileEntry, layout
from stickslip_schemas.store import DirectoryStore
from stickslip_services.queue.background import start
from stickslip_services.queue.context import Context
from stickslip_services.queue.integrity import row_digest
from stickslip_services.queue.planner import Planner
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import parsed
from stickslip_testing.worker import DirectApi, PretendWorker

BEFORE_SECONDS = 5.0
"""How long leases are measured while nothing is planned [s]."""

MOST_SECONDS = 120.0
"""How long leases are measured while a job is cancelled [s]."""


def cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Worker:
    """Leases ten tasks of a job and gives them back, over and over."""

    def __init__(self, client: httpx.Client, key: str, worker_id: str) -> None:
        self._client = client
        self._headers = {"Authorization": f"Bearer {key}"}
        self._id = worker_id

    def lease(self) -> float:
        """Return how long a lease takes [s]; give the tasks back."""
        begin = time.perf_counter()
        leases = self._post("lease", {"worker_id": self._id, "wanted": {"simulate": 10}})["leases"]
        seconds = time.perf_counter() - begin
        assert len(leases) == 10, "there must be tasks to lease"
        reports = [
            {"task_id": lease["task_id"], "token": lease["token"], "result": None}
            for lease in leases
        ]
        self._post("report", {"worker_id": self._id, "reports": reports})
        return seconds

    def _post(self, verb: str, document: dict[str, Any]) -> dict[str, Any]:
        answer = self._client.post(f"/v1/worker/{verb}", json=document, headers=self._headers)
        return answer.raise_for_status().json()  # type: ignore[no-any-return]


def summarise(seconds: list[float]) -> dict[str, float]:
    """Return the median, the 99th percentile and the longest of some times [s]."""
    ordered = sorted(seconds)
    return {
        "count": len(ordered),
        "median": round(statistics.median(ordered), 4),
        "p99": round(ordered[int(0.99 * (len(ordered) - 1))], 4),
        "longest": round(ordered[-1], 4),
    }


def plan(samples: int) -> dict[str, Any]:
    """Measure the submission and the planning of a job."""
    with tempfile.TemporaryDirectory() as directory, coordinator(Path(directory)) as (client, pid):
        key = (Path(directory) / "worker-key").read_text().strip()
        worker = Worker(client, key, client.get("/v1/workers").json()[0]["id"])
        client.post(
            "/v1/jobs", json=spec(500, start=900.0), params={"priority": 5}
        ).raise_for_status()
        before: list[float] = []
        end = time.perf_counter() + BEFORE_SECONDS
        while time.perf_counter() < end:
            before.append(worker.lease())
            time.sleep(0.05)
        cpu, begin = cpu_seconds(pid), time.perf_counter()
        job = client.post("/v1/jobs", json=spec(samples, start=0.0)).raise_for_status().json()
        result: dict[str, Any] = {
            "samples": samples,
            "submit_seconds": round(time.perf_counter() - begin, 3),
        }
        during: list[float] = []
        while job["state"] == "planning":
            during.append(worker.lease())
            time.sleep(0.05)
            if len(during) % 10 == 0:
                job = client.get(f"/v1/jobs/{job['id']}").json()
        result["planning_seconds"] = round(time.perf_counter() - begin, 1)
        result["coordinator_cpu_seconds"] = round(cpu_seconds(pid) - cpu, 1)
        result["state"], result["tasks"] = job["state"], job["progress"]["total"]
        result["lease_seconds_before"], result["lease_seconds_while_planning"] = (
            summarise(before),
            summarise(during),
        )
        result["coordinator_peak_mb"] = round(peak_megabytes(pid), 1)
        if (file := Path(directory) / "coordinator.sqlite3").exists():
            result["database_mb"] = round(file.stat().st_size / 1e6, 1)
        begin = time.perf_counter()
        client.post(f"/v1/jobs/{job['id']}:cancel").raise_for_status()
        result["cancel_seconds"] = round(time.perf_counter() - begin, 3)
        leases: list[float] = []
        reads: list[float] = []
        while job["state"] != "cancelled" and time.perf_counter() < begin + MOST_SECONDS:
            leases.append(worker.lease())
            asked = time.perf_counter()
            job = client.get(f"/v1/jobs/{job['id']}").json()
            reads.append(time.perf_counter() - asked)
            time.sleep(0.05)
        result["state"], result["cancelling_seconds"] = (
            job["state"],
            round(time.perf_counter() - begin, 1),
        )
        result["lease_seconds_while_cancelling"], result["read_seconds_while_cancelling"] = (
            summarise(leases),
            summarise(reads),
        )
    return result


class SlowStore(DirectoryStore):
    """A directory that answers like a bucket that is some milliseconds away."""

    delay = 0.0

    def publish(self, data: bytes) -> str:
        """A PUT."""
        self._wait(1)
        return super().publish(data)

    def read(self, digest: str, *, offset: int = 0, length: int | None = None) -> bytes:
        """A GET."""
        self._wait(1)
        return super().read(digest, offset=offset, length=length)

    def size(self, digest: str) -> int:
        """A HEAD."""
        self._wait(1)
        return super().size(digest)

    def holds(self, digest: str, *, size: int | None = None) -> bool:
        """A HEAD and a GET."""
        self._wait(2)
        return super().holds(digest, size=size)

    def show(self, digest: str, dataset: str, version: int, path: str) -> None:
        """A copy on the server."""
        self._wait(1)
        super().show(digest, dataset, version, path)

    def _wait(self, requests: int) -> None:
        time.sleep(requests * self.delay)


def publish(samples: int, delay: float) -> dict[str, Any]:
    """Measure the last task of a job, and reading what it made."""
    with tempfile.TemporaryDirectory() as directory:
        data = Path(directory)
        result: dict[str, Any] = {"samples": samples, "delay_seconds": delay}
        result["coordinator"] = _alone("_coordinate", data, samples, delay)
        version = next((data / "store/datasets").glob("ds-*/v1"))
        result["manifest_kb"] = round((version / "manifest.json").stat().st_size / 1e3, 1)
        result["files"] = sum(1 for path in version.rglob("*") if path.is_file())
        result["reader"] = _alone("_read", version)
    return result


def _alone(part_name: str, *arguments: object) -> dict[str, Any]:
    """Run a part in a process of its own."""
    command = [sys.executable, __file__, part_name, *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    document: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return document


def _timed(result: dict[str, Any], name: str, work: Callable[[], Any]) -> Any:
    wall, cpu = time.perf_counter(), time.process_time()
    value = work()
    result[f"{name}_seconds"] = round(time.perf_counter() - wall, 2)
    result[f"{name}_cpu_seconds"] = round(time.process_time() - cpu, 2)
    return value


def _coordinate(data: Path, samples: int, delay: float) -> dict[str, Any]:
    context = Context.open(Settings.chosen(data=data, durable=False))
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit_job(context, parsed(spec(samples, start=0.0) | {"views": None}), None)
    Planner(context).run()
    result: dict[str, Any] = {"planned_peak_mb": round(peak_megabytes(os.getpid()), 1)}
    _say_that_all_has_ended(context, DirectoryStore(data / "store"))
    result["before_peak_mb"] = round(peak_megabytes(os.getpid()), 1)
    context.store = slow = SlowStore(data / "store")
    slow.delay = delay
    (lease,) = _timed(result, "compose", lambda: worker.lease(publish=1))
    result["lease_kb"] = round(len(lease.model_dump_json()) / 1e3, 1)
    task = data / "task.json"
    task.write_text(lease.task.model_dump_json())
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(_alone, "_work", task, data / "store", delay)
        while not running.done():
            worker.beat(lease, started=True)
            time.sleep(1)
        answer = running.result()
    output = answer.pop("output")
    verdict = _timed(
        result, "check", lambda: worker.report((lease, TaskResult.model_validate(output)))
    )
    result["peak_mb"] = round(peak_megabytes(os.getpid()), 1)
    with context.database.read() as connection:
        state = connection.scalar(text("SELECT state FROM jobs"))
    assert (verdict, state) == (["accepted"], "succeeded"), (verdict, state, job)
    context.close()
    return result | {"worker": answer}


def _say_that_all_has_ended(context: Context, store: DirectoryStore) -> None:
    """Write results of all tasks but the last into the database, as if they had been reported."""
    record = RecordRef(digest=store.publish(b"a record"), row=0)
    with context.database.write() as connection:
        simulated = SimulateOutput(record=record, labels={}).model_dump_json()
        update = text(
            "UPDATE tasks SET state = 'succeeded', output = :output, digest = :digest, waiting_on "
            "= 0 WHERE seq = :seq"
        )

        def end(row: Row[Any], output: str) -> dict[str, Any]:
            digest = row_digest(row.key, "succeeded", None, "", output)
            return {"seq": row.seq, "output": output, "digest": digest}

        of_stage = text("SELECT seq, key, payload FROM tasks WHERE stage = :stage")
        simulations = connection.execute(of_stage, {"stage": "simulate"}).all()
        connection.execute(update, [end(row, simulated) for row in simulations])
        packs = connection.execute(of_stage, {"stage": "pack"}).all()
        outputs = _packed(context, store, [json.loads(row.payload)["shard"] for row in packs])
        for row, output in zip(packs, outputs, strict=True):
            connection.execute(update, end(row, output.model_dump_json()))
        connection.execute(text("UPDATE tasks SET waiting_on = 0 WHERE stage = 'publish'"))


def _packed(context: Context, store: DirectoryStore, shards: list[int]) -> Iterator[PackOutput]:
    """Yield outputs of the packs of a job of rods without pictures: curves that are all equal."""
    with context.database.read() as connection:
        row = connection.execute(text("SELECT seq, spec FROM jobs")).one()
        of_spec = parsed(json.loads(row.spec))
        rows = text(
            "SELECT key, split, labels FROM samples WHERE job = :job AND slot >= :first AND slot < "
            ":end ORDER BY slot"
        )
        size = of_spec.samples_per_shard
        curves = [array for array in layout(of_spec) if not array.is_label]
        # Some different ones: a file can have only so many hard links.
        shapes = [
            [
                store.publish(encode_chunk(np.full((size, *array.shape), n, array.dtype)))
                for array in curves
            ]
            for n in range(64)
        ]
        sizes = {digest: store.size(digest) for digests in shapes for digest in digests}
        for shard in shards:
            samples_of_shard = connection.execute(
                rows, {"job": row.seq, "first": shard * size, "end": (shard + 1) * size}
            ).all()
            labels = [json.loads(sample.labels) for sample in samples_of_shard]
            columns = []
            for array in layout(of_spec):
                if array.is_label:
                    values = np.zeros((len(samples_of_shard), *array.shape), array.dtype)
                    if array.name == "sample_key":
                        values[:] = np.frombuffer(
                            b"".join(sample.key for sample in samples_of_shard), np.uint8
                        ).reshape(-1, 32)
                    elif array.name == "split":
                        values[:] = [sample.split for sample in samples_of_shard]
                    elif array.name == "valid":
                        values[:] = True
                    elif array.name in labels[0]:
                        values[:] = [label[array.name] for label in labels]
                    columns.append(encode_chunk(values))
            yield PackOutput(
                files=tuple(
                    FileEntry(path=array.shard_path(shard), sha256=digest, size=sizes[digest])
                    for array, digest in zip(curves, shapes[shard % len(shapes)], strict=True)
                ),
                labels=store.publish(encode_shard(columns)),
            )


def _work(task: Path, store: Path, delay: float) -> dict[str, Any]:
    from stickslip_workers.stages.publish import publish

    slow = SlowStore(store)
    slow.delay = delay
    result: dict[str, Any] = {}
    task_document = PublishTask.model_validate_json(task.read_bytes())
    done = _timed(result, "publish", lambda: publish(task_document, slow))
    result["peak_mb"] = round(peak_megabytes(os.getpid()), 1)
    return result | {"output": done.model_dump(mode="json")}


def _read(version: Path) -> dict[str, Any]:
    from stickslip_training.data.reader import DatasetReader

    result: dict[str, Any] = {"before_mb": round(peak_megabytes(os.getpid()), 1)}
    reader = _timed(result, "open", lambda: DatasetReader(version))
    slots = _timed(result, "list", lambda: reader.slots("train"))
    slots_of_label = _timed(result, "filter", lambda: slots[reader.label("gamma")[slots] < 10.0])
    result["found"] = [len(reader), len(slots), len(slots_of_label)]
    result["peak_mb"] = round(peak_megabytes(os.getpid()), 1)
    _timed(result, "sample", lambda: reader.read("centerline", [len(reader) // 2]))
    result["with_a_sample_peak_mb"] = round(peak_megabytes(os.getpid()), 1)
    return result


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] and sys.argv[1].startswith("_"):
        part_name, *part_arguments = sys.argv[1:]
        parts: dict[str, Callable[..., dict[str, Any]]] = {
            "_coordinate": lambda data, samples, delay: _coordinate(
                Path(data), int(samples), float(delay)
            ),
            "_work": lambda task, store, delay: _work(Path(task), Path(store), float(delay)),
            "_read": lambda version: _read(Path(version)),
        }
        print(json.dumps(parts[part_name](*part_arguments)))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("plan", "publish"))
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--database", help="URL of an empty PostgreSQL database, for plan")
    parser.add_argument(
        "--delay", type=float, default=0.025, help="of each request to the store [s]"
    )
    arguments = parser.parse_args()
    if arguments.database is not None:
        os.environ["STICKSLIP_DATABASE"] = arguments.database
    measure = plan if arguments.what == "plan" else partial(publish, delay=arguments.delay)
    print(json.dumps(measure(arguments.samples), indent=2))


if __name__ == "__main__":
    main()
