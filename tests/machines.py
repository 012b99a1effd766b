"""Machines on a network of their own, for tests that kill them or pull their cables.

Each is a network namespace with a cable to a bridge, and what runs on it has pids and a host name
of its own. The one with the bridge is the hub: it has the coordinator, PostgreSQL and a bucket, and
the test runs there. Nothing of the network outside of the namespaces is touched. It needs root,
`ip` and `unshare`; see the fixtures `hub` and `lab`.
"""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
from harness import command_line, pids, wait_for
from sqlalchemy import func, select, text
from stickslip_schemas.base import Stage
from stickslip_services.database.database import Database
from stickslip_services.database.tables import tasks, workers
from stickslip_testing.invariants import violations

HUB = "10.213.0.1"
URL = f"http://{HUB}:8765"
BUCKET = "s3://lab/store"
RODS = 120
"""Samples of each job; there is always one that is not over."""
CLONE_NEWNET = 0x40000000


def dies_with_us() -> None:
    """Let the kernel end this process when the test does, however it does [prctl(2)]."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def ip(*words: str, within: int | None = None) -> None:
    inside = [] if within is None else ["nsenter", f"--net=/proc/{within}/ns/net", "--"]
    subprocess.run([*inside, "ip", *words], check=True)


@contextmanager
def namespace() -> Iterator[int]:
    """Hold a network namespace; yield the pid of a process in it."""
    with subprocess.Popen(
        ["unshare", "--net", "sleep", "infinity"], preexec_fn=dies_with_us
    ) as holder:
        try:
            name = Path(f"/proc/{holder.pid}/comm")
            wait_for(
                "a namespace", lambda: True if name.read_text().strip() == "sleep" else None, 10
            )
            ip("link", "set", "lo", "up", within=holder.pid)
            yield holder.pid
        finally:
            holder.kill()


@contextmanager
def entered(pid: int) -> Iterator[None]:
    """Let this process, and what it starts, be on the network of another one."""
    libc = ctypes.CDLL(None, use_errno=True)

    def enter(network: int) -> None:
        if libc.setns(network, CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), "setns")

    home, other = (os.open(f"/proc/{name}/ns/net", os.O_RDONLY) for name in ("self", pid))
    try:
        enter(other)
        yield
    finally:
        enter(home)
        os.close(home)
        os.close(other)


class Machine:
    """A machine with a cable to the hub."""

    def __init__(self, name: str, number: int, hub: int, stack: ExitStack) -> None:
        self.name = name
        self.address = f"10.213.0.{number}"
        self._hub = hub
        self._holder = stack.enter_context(namespace())
        self._process: subprocess.Popen[bytes] | None = None
        self._cable = f"cable-{name}"
        ends = [
            ["name", self._cable, "netns", str(hub)],
            ["name", "eth0", "netns", str(self._holder)],
        ]
        ip("link", "add", *ends[0], "type", "veth", "peer", *ends[1])
        ip("link", "set", self._cable, "master", "br0", "up", within=hub)
        ip("address", "add", f"{self.address}/24", "dev", "eth0", within=self._holder)
        ip("link", "set", "eth0", "up", within=self._holder)
        stack.callback(self.kill)

    def start(self, command: Collection[str], log: Path, is_pod: bool = False) -> None:
        """Let the machine do something; what it says goes to a file. Files of /tmp/ray are its own.

        A pod starts again where its command ends, as Kubernetes starts its container again.
        """
        inside = ["nsenter", f"--net=/proc/{self._holder}/ns/net", "--"]
        if is_pod:
            again = 'while :; do "$@"; sleep 2; done'
            inside += ["unshare", "--pid", "--fork", "--kill-child", "sh", "-c", again, "pod"]
        alone = ["unshare", "--pid", "--mount", "--mount-proc", "--uts", "--fork", "--kill-child"]
        script = 'hostname "$0" && mkdir -p /tmp/ray && mount -t tmpfs tmpfs /tmp/ray && exec "$@"'
        named = ["sh", "-c", script, self.name]
        with log.open("ab") as file:
            self._process = subprocess.Popen(
                [*inside, *alone, *named, *command],
                stdout=file,
                stderr=file,
                preexec_fn=dies_with_us,
            )

    def kill(self) -> None:
        """Let all processes die at once: the kernel kills who has pids below one that dies."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def processes(self) -> Iterator[tuple[int, str]]:
        """Yield the pid and the command line of each process."""
        for pid in pids():
            with suppress(OSError):
                if pid != self._holder and Path(f"/proc/{pid}/ns/net").samefile(
                    f"/proc/{self._holder}/ns/net"
                ):
                    yield pid, command_line(pid)

    def is_at_work(self) -> bool:
        """Return whether a task runs here: Ray names processes after their tasks."""
        return any(
            line.startswith(tuple(f"ray::{stage.value}" for stage in Stage))
            for _, line in self.processes()
        )

    def freeze(self) -> None:
        """Let all processes stop, as those of a machine that hangs."""
        for pid, _ in self.processes():
            os.kill(pid, signal.SIGSTOP)

    def plug(self, how: str) -> None:
        """Plug the cable in (`up`), or pull it (`down`)."""
        ip("link", "set", self._cable, how, within=self._hub)


def dispatch(name: str, place: Path) -> list[str]:
    """Return the command of a worker; the coordinator has its key in a file of `place`."""
    words = [
        "--url",
        URL,
        "--store",
        BUCKET,
        "--name",
        name,
        "--max-cpus",
        "1",
        "--key-file",
        str(place / "worker-key"),
    ]
    return [sys.executable, "-m", "stickslip_workers", "dispatch", *words]


class Lab:
    """What the test sees of the queue."""

    def __init__(self, database: Database, client: httpx.Client, logs: Path) -> None:
        self._logs = logs
        self._database = database
        self._http = client
        self.jobs: list[str] = []

    def keep_busy(self) -> None:
        """Submit another job where the last one is nearly over."""
        with self._database.read() as connection:
            query = select(tasks.c.state == "succeeded", func.count()).where(
                tasks.c.stage == "render"
            )
            counts = {
                bool(is_done): count
                for is_done, count in connection.execute(query.group_by(text("1")))
            }
        is_planned = sum(counts.values()) == RODS * len(
            self.jobs
        )  # the first one is when a worker has come
        if self.jobs and not (is_planned and counts.get(False, 0) < RODS // 3):
            return
        gamma = {"type": "linspace", "start": 100, "stop": 1300, "num": RODS}
        axes = {
            "gamma": gamma,
            "phi0": 0.2,
            "phi1": 6.0 + 0.1 * len(self.jobs),
        }  # no two jobs share a sample
        spec = {"kind": "rod_hang", "axes": axes, "quality": "draft", "samples_per_shard": 50}
        answer = self._http.post("/v1/jobs", json=spec)
        assert answer.status_code == 202, answer.text
        self.jobs.append(answer.json()["id"])

    def _rows(self, *columns: Any, name: str, of: Any) -> list[Any]:
        """Return columns of the tasks whose `of` is a session of the worker of a name."""
        with self._database.read() as connection:
            query = select(*columns).join(workers, workers.c.id == of).where(workers.c.name == name)
            return list(connection.execute(query))

    def held(self, name: str) -> dict[int, str]:
        """Return the tasks that a worker holds, and their states: `running` where a heartbeat has
        said so.
        """
        return {
            row.seq: row.state
            for row in self._rows(tasks.c.seq, tasks.c.state, name=name, of=tasks.c.owner)
        }

    def done(self, name: str) -> int:
        """Return how many tasks a worker has done."""
        return len(self._rows(tasks.c.seq, name=name, of=tasks.c.reported_by))

    def left(self, seqs: Collection[int]) -> int:
        """Return how many of some tasks are not done."""
        with self._database.read() as connection:
            query = select(func.count()).where(tasks.c.seq.in_(seqs), tasks.c.state != "succeeded")
            return int(connection.scalar(query) or 0)

    def sums(self) -> tuple[int, int]:
        """Return the tries that tasks were charged with, and the losses."""
        with self._database.read() as connection:
            tries, losses = connection.execute(
                select(func.sum(tasks.c.tries), func.sum(tasks.c.losses))
            ).one()
        return int(tries), int(losses)

    def wait(self, condition: str, is_so: Callable[[], bool], seconds: float = 240) -> float:
        """Wait for something while there is work; return how long it took."""
        begin = time.monotonic()

        def probe() -> bool | None:
            self.keep_busy()
            return True if is_so() else None

        try:
            wait_for(condition, probe, seconds)
        except AssertionError as error:
            for log in sorted(self._logs.glob("*.log")):
                lines = log.read_text(errors="replace").splitlines()[-15:]
                error.add_note("\n".join([f"{log.name}:", *(line[:200] for line in lines)]))
            raise
        return time.monotonic() - begin

    def worker(self, name: str) -> dict[str, Any]:
        """Return the live worker of a name, with how it says that it is, if one exists; otherwise
        {}.
        """
        workers: list[dict[str, Any]] = self._http.get("/v1/workers").json()
        return next((entry for entry in workers if entry["name"] == name and entry["alive"]), {})

    def finished(self) -> list[str]:
        """Wait until all jobs are over; return their states."""

        def probe() -> list[str] | None:
            jobs = [self._http.get(f"/v1/jobs/{job}").json() for job in self.jobs]
            return (
                [job["state"] for job in jobs] if all(job["finished_at"] for job in jobs) else None
            )

        return wait_for("the end of all jobs", probe, 300)

    def faults(self) -> list[str]:
        with self._database.read() as connection:
            return [str(fault) for fault in violations(connection)]


@contextmanager
def running(place: Path, name: str, words: list[str], port: int) -> Iterator[None]:
    """Run a server of the hub's."""
    with (place / f"{name}.log").open("wb") as log:
        command = [sys.executable, "-W", "ignore", *words]
        process = subprocess.Popen(command, stdout=log, stderr=log, preexec_fn=dies_with_us)

    def is_there() -> bool | None:
        assert process.poll() is None, (place / f"{name}.log").read_text()
        try:
            return (
                httpx.get(f"http://{HUB}:{port}/readyz", trust_env=False).status_code < 500 or None
            )
        except httpx.TransportError:
            return None

    try:
        wait_for(name, is_there, 120)
        yield
    finally:
        process.terminate()
        process.wait(30)
