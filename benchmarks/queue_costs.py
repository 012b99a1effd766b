"""The cost of the coordinator: leases, reports, many watchers of a job, many clients at once.

    python benchmarks/queue_costs.py [--watchers 500] [--seconds 10] [--database postgresql://...]

A coordinator runs as a process of its own with a database on a real disk, and its CPU time is read
from /proc. That of a PostgreSQL server on this machine is shown beside it: of all its processes, so
nothing else may use it. Workers pretend: their results are made up and lie in the store. Times of
many clients depend on what else the machine does, so the load is printed with them.
"""

import argparse
import asyncio
import itertools
import os
import resource
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from stickslip_schemas.documents.worker_api import Heartbeat, LeaseState
from stickslip_services.access.keys import create_key
from stickslip_services.access.principals import Scope
from stickslip_services.api.protocol import allow_many_files
from stickslip_services.api.sse import MAX_STREAMS
from stickslip_services.database.database import Role
from stickslip_services.database.opening import connect
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import HttpApi, ServerProcess, start_server
from stickslip_testing.worker import PretendWorker


def cpu_seconds(server: ServerProcess) -> float:
    """Return the CPU time that a server has taken so far [s]."""
    fields = Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def database_seconds() -> float:
    """Return the CPU time [s] of the PostgreSQL servers of this machine, with ended sessions."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has just ended
            name, _, rest = path.read_text().rpartition(")")
            if name.endswith("(postgres"):
                ticks += sum(
                    map(int, rest.split()[11:15])
                )  # its own, and those of its children that have ended
    return ticks / os.sysconf("SC_CLK_TCK")


def submit(server: ServerProcess, count: int, **spec: Any) -> str:
    """Submit rods with `count` simulations; return the job when it is planned."""
    grid = rods(gamma=[1.0 + number for number in range(count)], phi1=[1.0], **spec)
    with httpx.Client(base_url=server.url, timeout=60, trust_env=False) as client:
        job = client.post("/v1/jobs", json=grid).json()
        while job["state"] == "planning":
            time.sleep(0.1)
            job = client.get(f"/v1/jobs/{job['id']}").json()
    return str(job["id"])


def report_lease_and_complete(
    server: ServerProcess, worker: PretendWorker, batch: int, count: int
) -> None:
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
    wall, spent, other = (
        time.perf_counter() - begin,
        cpu_seconds(server) - cpu,
        database_seconds() - other,
    )
    print(
        f"lease and complete, {batch} at a time: {1e3 * spent / done:.2f} CPU ms each, "
        f"{done / wall:.0f} a second"
        + (
            f"; {1e3 * other / done:.2f} CPU ms of PostgreSQL"
            if "STICKSLIP_DATABASE" in os.environ
            else ""
        )
    )


async def report_watchers(
    server: ServerProcess, worker: PretendWorker, count: int, seconds: float
) -> None:
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
            ids += [
                line
                async for line in response.aiter_lines()
                if line.startswith(("id: ", "event: "))
            ]

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
    answers = {
        tuple(dict.fromkeys(a for a, b in itertools.pairwise(ids) if "job.state" in b))
        for ids in heard
    }
    print(
        f"{count} watchers: {share:.0%} of a core; every one heard the same states: "
        f"{len(answers) == 1}"
    )


async def report_clients(
    server: ServerProcess, worker: PretendWorker, count: int, seconds: float
) -> None:
    """Let many clients ask once a second while a job runs."""
    job = submit(server, 400, poisson=0.32)
    took: list[float] = []
    stop = threading.Event()

    def work() -> None:
        while not stop.wait(0.05):
            worker.finish(*worker.lease(simulate=4, render=4))

    async def ask(client: httpx.AsyncClient, number: int) -> None:
        await asyncio.sleep(number / count)
        for path in ("/v1/jobs", f"/v1/jobs/{job}", f"/v1/jobs/{job}/samples", "/v1/workers") * int(
            seconds // 4 + 1
        ):
            begin = time.perf_counter()
            (await client.get(path)).raise_for_status()
            took.append(time.perf_counter() - begin)
            await asyncio.sleep(max(0.0, 1.0 - took[-1]))

    thread = threading.Thread(target=work)
    thread.start()
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(
        base_url=server.url, trust_env=False, limits=limits, timeout=30
    ) as client:
        await asyncio.gather(*(ask(client, number) for number in range(count)))
        stop.set()
        await asyncio.to_thread(thread.join)
        await client.post(f"/v1/jobs/{job}:cancel")
    took.sort()
    p50, p95, p99 = (1e3 * took[int(share * len(took))] for share in (0.5, 0.95, 0.99))
    print(
        f"{count} clients, one request a second each: p50 {p50:.0f}, p95 {p95:.0f}, p99 {p99:.0f} "
        "ms"
    )


def use_api(
    server: ServerProcess, worker: PretendWorker, job: str, seconds: float
) -> dict[str, list[float]]:
    """Use the API for a while; return the times of the calls by what they are for [s]."""
    times_of: dict[str, list[float]] = {"worker API": [], "reads": []}

    def timed(name: str, call: Callable[[], object]) -> Any:
        begin = time.perf_counter()
        answer = call()
        times_of[name].append(time.perf_counter() - begin)
        return answer

    with httpx.Client(trust_env=False, timeout=30) as client:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            leases = timed("worker API", partial(worker.lease, simulate=1))
            timed("worker API", partial(worker.start, *leases))
            timed("worker API", partial(worker.finish, *leases))
            for path in ("/v1/jobs", f"/v1/jobs/{job}", "/v1/workers"):
                timed("reads", partial(client.get, server.url + path))
            time.sleep(0.1)
    return times_of


async def print_times(
    server: ServerProcess, worker: PretendWorker, job: str, seconds: float, title: str
) -> None:
    """Use the API for a while, and print the CPU time, the memory and the times of calls."""
    cpu_before = cpu_seconds(server)
    times_of = await asyncio.to_thread(use_api, server, worker, job, seconds)
    fraction = (cpu_seconds(server) - cpu_before) / seconds
    load = os.getloadavg()[0]
    print(f"{title}: {fraction:.0%} of a core, {memory(server):.0f} MiB, load {load:.1f}")
    for name, times in times_of.items():
        times.sort()
        p50 = 1e3 * times[int(0.5 * len(times))]
        p99 = 1e3 * times[int(0.99 * len(times))]
        print(
            f"    {name}: {len(times)} calls, p50 {p50:.0f}, p99 {p99:.0f}, longest "
            f"{1e3 * times[-1]:.0f} ms"
        )


async def report_idle_streams(
    server: ServerProcess, worker: PretendWorker, count: int, seconds: float
) -> None:
    """Open idle event streams from as many addresses and keys as they need, and 100 too many.

    Use the API meanwhile.
    """
    job, watched = submit(server, 800, poisson=0.33), submit(server, 4, poisson=0.331)
    httpx.post(f"{server.url}/v1/jobs/{watched}:pause", trust_env=False).raise_for_status()
    host, port = server.url.removeprefix("http://").split(":")
    database = connect(Settings.chosen(data=server.data), Role.visitor)
    with database.write() as connection:
        names = [f"stream-{number}" for number in range(1 + count // MAX_STREAMS)]
        keys = [create_key(connection, name, [Scope.admin], time.time())[1] for name in names]
    database.close()
    await asyncio.sleep(2)  # a coordinator looks for new keys once a second
    request = f"GET /v1/jobs/{watched}/events HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer "
    statuses: Counter[bytes] = Counter()
    writers: list[asyncio.StreamWriter] = []

    async def open_stream(number: int) -> None:
        client_number = number // MAX_STREAMS
        reader, writer = await asyncio.open_connection(
            host, int(port), local_addr=(f"127.0.0.{1 + client_number}", 0)
        )
        writer.write(f"{request}{keys[client_number]}\r\n\r\n".encode())
        statuses[(await reader.readline()).split()[1]] += 1
        writers.append(writer)
        with suppress(OSError):
            while await reader.read(65536):  # what nobody reads would stay in the server
                pass

    await print_times(server, worker, job, seconds, "no stream")
    readers = []
    for number in range(count + 100):
        readers.append(asyncio.create_task(open_stream(number)))
        if number % 50 == 49:
            await asyncio.sleep(0.1)
    while statuses.total() < count + 100:
        await asyncio.sleep(0.1)
    title = f"{count} idle streams and 100 too many, {dict(statuses)}"
    await print_times(server, worker, job, seconds, title)
    for reader, writer in zip(readers, writers, strict=True):
        writer.close()
        reader.cancel()


def memory(server: ServerProcess) -> float:
    """Return the memory of a server [MiB]."""
    return (
        int(Path(f"/proc/{server.process.pid}/statm").read_text().split()[1])
        * resource.getpagesize()
        / 2**20
    )


def report_heartbeats(
    server: ServerProcess, worker: PretendWorker, held: int, senders: int, seconds: float
) -> None:
    """Send heartbeats of workers with so many leases each, over connections that are kept.

    They are sent as bytes that were made before: what a dispatcher spends on its own machine is not
    to be measured.
    """
    submit(server, held * senders, poisson=0.34)
    key = (server.data / "worker-key").read_text().strip()
    host, port = server.url.removeprefix("http://").split(":")
    counts = [0] * senders
    requests = []
    for number in range(senders):
        worker_of_client = PretendWorker(
            worker.api, server.store, name=f"beats-{number}"
        ).register()
        leases = tuple(
            LeaseState(task_id=i.task_id, token=i.token, started=False)
            for i in worker_of_client.lease(simulate=held)
        )
        assert len(leases) == held
        body = Heartbeat(
            worker_id=worker_of_client.id, leases=leases, condition=worker_of_client.condition
        ).model_dump_json()
        lines = f"Host: {host}", f"Authorization: Bearer {key}", "Content-Type: application/json"
        head = "\r\n".join(
            ["POST /v1/worker/heartbeat HTTP/1.1", *lines, f"Content-Length: {len(body)}"]
        )
        requests.append(f"{head}\r\n\r\n{body}".encode())
    end = time.perf_counter() + seconds

    def send(number: int) -> None:
        with socket.create_connection((host, int(port)), timeout=60) as connection:
            while time.perf_counter() < end:
                connection.sendall(requests[number])
                answer = connection.recv(65536)
                while not answer.endswith(b"}"):
                    answer += connection.recv(65536)
                assert answer.endswith(b'{"drop":[]}'), answer
                counts[number] += 1

    threads = [threading.Thread(target=send, args=(number,)) for number in range(senders)]
    cpu, other, own_cpu = cpu_seconds(server), database_seconds(), time.process_time()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    total = sum(counts)
    took = (cpu_seconds(server) - cpu, database_seconds() - other, time.process_time() - own_cpu)
    spent, database, sender = (1e3 * seconds / total for seconds in took)
    print(
        f"heartbeats with {held} leases, {senders} workers: {total / seconds:.0f} a second beside "
        "the load of this "
        f"machine; {spent:.2f} CPU ms each, so one core takes {1e3 / spent:.0f} a second; "
        f"{sender:.2f} CPU ms to send"
        + (f", {database:.2f} of PostgreSQL" if "STICKSLIP_DATABASE" in os.environ else "")
    )


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--watchers", type=int, default=500)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument(
        "--streams", type=int, default=0, help="idle event streams; 2000 are the most"
    )
    parser.add_argument(
        "--beats", type=int, default=0, help="workers that send heartbeats with 64 leases each"
    )
    parser.add_argument("--tasks", type=int, default=6401, help="to lease and complete; 0: none")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--database", help="URL of an empty PostgreSQL database")
    options = parser.parse_args()
    if options.database is not None:
        os.environ["STICKSLIP_DATABASE"] = options.database
    allow_many_files()
    with tempfile.TemporaryDirectory() as directory:
        server = start_server(Path(directory) / "data")
        try:
            worker = server.worker()
            with httpx.Client(
                trust_env=False, timeout=30
            ) as client:  # as a dispatcher, which keeps its connection
                key = (server.data / "worker-key").read_text().strip()
                steady = PretendWorker(
                    HttpApi(server.url, key, client.post), server.store, name="steady"
                ).register()
                print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
                if options.tasks:
                    report_lease_and_complete(server, steady, 1, 1 + options.tasks // 10)
                    report_lease_and_complete(server, steady, 16, options.tasks)
                if options.streams:
                    asyncio.run(
                        report_idle_streams(server, steady, options.streams, options.seconds)
                    )
                if options.beats:
                    report_heartbeats(server, steady, 64, options.beats, options.seconds)
            if options.watchers:
                asyncio.run(report_watchers(server, worker, options.watchers, options.seconds))
            if options.clients:
                asyncio.run(report_clients(server, worker, options.clients, options.seconds))
            print(f"load {os.getloadavg()[0]:.1f}")
        finally:
            server.stop()


if __name__ == "__main__":
    main()
