"""What the coordinator costs: leasing and completing tasks, many watchers of one job, many clients at once.

    python benchmarks/queue_costs.py [--watchers 500] [--seconds 10] [--database postgresql://...]

A coordinator runs as a process of its own with a database on a real disk, and its CPU time is read from /proc. That of
a PostgreSQL server on this machine is shown beside it: of all its processes, so nothing else may use it. Workers
pretend: their results are made up and lie in the store. Times of many clients depend on what else the machine does, so
the load is printed with them.
"""

import argparse
import asyncio
import itertools
import os
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
from stickslip_services.addresses import DATABASE_VARIABLE
from stickslip_testing.jobs import rods
from stickslip_testing.servers import HttpApi, ServerProcess, start_server
from stickslip_testing.worker import PretendWorker


def cpu_seconds(server: ServerProcess) -> float:
    """Return the CPU time that a server has taken so far [s]."""
    fields = Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def database_seconds() -> float:
    """Return the CPU time of the PostgreSQL servers of this machine, with all sessions that have ended [s]."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has just ended
            name, _, rest = path.read_text().rpartition(")")
            if name.endswith("(postgres"):
                ticks += sum(map(int, rest.split()[11:15]))  # its own, and those of its children that have ended
    return ticks / os.sysconf("SC_CLK_TCK")


def submit(server: ServerProcess, count: int, **spec: Any) -> str:
    """Submit rods with `count` simulations; return the job."""
    grid = rods(gamma=[1.0 + number for number in range(count)], phi1=[1.0], **spec)
    return str(httpx.post(f"{server.url}/v1/jobs", json=grid, timeout=60, trust_env=False).json()["id"])


def report_lease_and_complete(server: ServerProcess, worker: PretendWorker, batch: int, count: int) -> None:
    """Lease and complete simulations, so many with a request."""
    submit(server, count, poisson=0.1 + 0.001 * batch, views=None)
    (first,) = worker.lease(simulate=1)
    result = worker.result(first.task)  # of all, for the worker's own time is not to be measured
    worker.report((first, result))
    count -= 1
    done = 0
    begin, cpu, other = time.perf_counter(), cpu_seconds(server), database_seconds()
    while done < count:
        leases = worker.lease(simulate=batch)
        worker.report(*((lease, result) for lease in leases))
        done += len(leases)
    wall, spent, other = time.perf_counter() - begin, cpu_seconds(server) - cpu, database_seconds() - other
    print(
        f"lease and complete, {batch} at a time: {1e3 * spent / done:.2f} CPU ms each, {done / wall:.0f} a second"
        + (f"; {1e3 * other / done:.2f} CPU ms of PostgreSQL" if DATABASE_VARIABLE in os.environ else "")
    )


async def report_watchers(server: ServerProcess, worker: PretendWorker, count: int, seconds: float) -> None:
    """Let many watch one job that goes on."""
    job = submit(server, 400, poisson=0.31)
    heard: list[list[str]] = []
    stop = threading.Event()

    def work() -> None:
        while not stop.wait(0.5):
            worker.finish(*worker.lease(simulate=4, render=4))

    async def watch(client: httpx.AsyncClient) -> None:
        ids: list[str] = []
        heard.append(ids)
        async with client.stream("GET", f"/v1/jobs/{job}/events", timeout=60) as response:
            ids += [line async for line in response.aiter_lines() if line.startswith(("id: ", "event: "))]

    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=server.url, trust_env=False, limits=limits) as client:
        watchers = [asyncio.create_task(watch(client)) for _ in range(count)]
        thread = threading.Thread(target=work)
        thread.start()
        await asyncio.sleep(5)
        begin, cpu = time.perf_counter(), cpu_seconds(server)
        await asyncio.sleep(seconds)
        share = (cpu_seconds(server) - cpu) / (time.perf_counter() - begin)
        stop.set()
        await asyncio.to_thread(thread.join)
        await client.post(f"/v1/jobs/{job}:cancel")
        await asyncio.wait_for(asyncio.gather(*watchers), 60)
    told = {tuple(dict.fromkeys(a for a, b in itertools.pairwise(ids) if "job.state" in b)) for ids in heard}
    print(f"{count} watchers: {share:.0%} of a core; every one heard the same states: {len(told) == 1}")


async def report_clients(server: ServerProcess, worker: PretendWorker, count: int, seconds: float) -> None:
    """Let many clients ask once a second while a job runs."""
    job = submit(server, 400, poisson=0.32)
    took: list[float] = []
    stop = threading.Event()

    def work() -> None:
        while not stop.wait(0.05):
            worker.finish(*worker.lease(simulate=4, render=4))

    async def ask(client: httpx.AsyncClient, number: int) -> None:
        await asyncio.sleep(number / count)
        for path in ("/v1/jobs", f"/v1/jobs/{job}", f"/v1/jobs/{job}/samples", "/v1/workers") * int(seconds // 4 + 1):
            begin = time.perf_counter()
            (await client.get(path)).raise_for_status()
            took.append(time.perf_counter() - begin)
            await asyncio.sleep(max(0.0, 1.0 - took[-1]))

    thread = threading.Thread(target=work)
    thread.start()
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=server.url, trust_env=False, limits=limits, timeout=30) as client:
        await asyncio.gather(*(ask(client, number) for number in range(count)))
        stop.set()
        await asyncio.to_thread(thread.join)
        await client.post(f"/v1/jobs/{job}:cancel")
    took.sort()
    p50, p95, p99 = (1e3 * took[int(share * len(took))] for share in (0.5, 0.95, 0.99))
    print(f"{count} clients, one request a second each: p50 {p50:.0f}, p95 {p95:.0f}, p99 {p99:.0f} ms")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--watchers", type=int, default=500)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--database", help="URL of an empty PostgreSQL database")
    options = parser.parse_args()
    if options.database is not None:
        os.environ[DATABASE_VARIABLE] = options.database
    with tempfile.TemporaryDirectory() as directory:
        server = start_server(Path(directory) / "data")
        try:
            worker = server.worker()
            with httpx.Client(trust_env=False, timeout=30) as client:  # as a dispatcher, which keeps its connection
                key = (server.data / "worker-key").read_text().strip()
                steady = PretendWorker(HttpApi(server.url, key, client.post), server.store, name="steady").register()
                print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
                report_lease_and_complete(server, steady, 1, 601)
                report_lease_and_complete(server, steady, 16, 6401)
            if options.watchers:
                asyncio.run(report_watchers(server, worker, options.watchers, options.seconds))
            if options.clients:
                asyncio.run(report_clients(server, worker, options.clients, options.seconds))
            print(f"load {os.getloadavg()[0]:.1f}")
        finally:
            server.stop()


if __name__ == "__main__":
    main()
