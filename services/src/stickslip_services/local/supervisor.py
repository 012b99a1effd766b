"""The processes on a machine: their memory, lock, socket and log, and `stickslip up`.

`stickslip up` runs a coordinator, a Ray and a dispatcher, restarted until the supervisor stops. All
files are below one directory: `coordinator.sqlite3`, `store/`, `logs/`, `url` (the address) and
`lock` (against a second supervisor).

Children that die are restarted with growing delays. A Ray or a dispatcher that fails to start five
times in a row ends the supervisor, which prints the end of its log. A coordinator that has answered
once is restarted forever, since work that is running needs no coordinator for a while.

The supervisor rotates the logs of its children by size and age, and on SIGHUP.
"""

import ctypes
import fcntl
import os
import shlex
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import httpx
from stickslip_schemas.store import write_durably

from stickslip_services.errors import CommandError, DatabaseRefusedError
from stickslip_services.local.child import Child
from stickslip_services.local.rotation import DAY_SECONDS, LogRotation
from stickslip_services.settings import Settings

_M_ARENA_MAX = -8  # of glibc's malloc.h


def limit_arenas() -> None:
    """Let all threads allocate from two arenas of glibc.

    With one for each, every arena keeps memory that it freed.
    """
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


LOCK_SECONDS = 10.0
"""Wait for the coordinator of a killed `stickslip up` to release the lock [s]."""


@contextmanager
def locked(data: Path) -> Iterator[int]:
    """Hold the lock of a data directory.

    One coordinator or one `stickslip up` may use it at a time. Yield the file descriptor of the
    lock. A process that inherits it holds the lock, too, until it ends. Raise DatabaseRefusedError
    if another process holds it.
    """
    data.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = data / "lock"
    with path.open("a+") as file:
        deadline = time.monotonic() + LOCK_SECONDS
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = path.read_text(encoding="utf-8").strip()
                # After a kill of `stickslip up`, its coordinator holds the lock for another moment.
                if Path("/proc", holder or "nobody").exists() or time.monotonic() > deadline:
                    raise DatabaseRefusedError(
                        f"{path.parent} is in use by another `stickslip up` or coordinator "
                        f"(pid {holder})"
                    ) from None
                time.sleep(0.1)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield file.fileno()


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to a port, but does not accept connections yet.

    Raise CommandError if the port is taken.
    """
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
    except OSError as error:
        listener.close()
        rule = f"cannot listen on {host}:{port}: {error.strerror}. `--port 0` takes any free port."
        raise CommandError(rule) from error
    return listener


ANSWER_SECONDS = 180.0
"""Time limit for the coordinator's first answer [s]; migrations may be slow while simulations use
all cores.
"""

FAILED_START_SECONDS = {"coordinator": 5.0, "ray": 60.0, "dispatcher": 5.0}
"""A child that dies within this time of its start has failed to start [s]. Ray gives up after 15 to
30 s if it cannot reach one of its own processes.
"""

STOP_SECONDS = {"coordinator": 4.0, "ray": 4.0, "dispatcher": 6.0}
"""Time limit for each child to stop before it is killed [s]."""

BACKLOG = 512
"""Connections that wait while the coordinator restarts."""

_TICK_SECONDS = 0.1

_ROTATION_SECONDS = 1.0
"""Time between two looks at the sizes of the logs [s]."""


@dataclass(slots=True)
class Signals:
    """Signals that have arrived, oldest first."""

    stops: list[int] = field(default_factory=list)
    """SIGINT, SIGTERM, and the SIGHUP of a terminal that was closed."""
    rotations: list[int] = field(default_factory=list)
    """SIGHUP without a terminal: rotate the logs now, as services do on it."""


def run(
    settings: Settings,
    *,
    name: str,
    slots: int | None,
    workers: str | None,
    on_ready: Callable[[str], None],
) -> int:
    """Run until a signal to stop; return the exit status. Raise CommandError.

    `settings` are those of the coordinator, with an absolute path of `data`; `name` is that of the
    dispatcher among all that have the same database. `workers` is another command than `python -m
    stickslip_workers`, for tests.
    """
    data = settings.data
    (data / "logs").mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        # Before anything else: a second supervisor must not touch what the first has.
        lock = stack.enter_context(locked(data))
        signals = _catch_signals()
        # The supervisor owns the socket, so requests wait while the coordinator restarts.
        listener = stack.enter_context(listen(settings.host, settings.port))
        listener.listen(BACKLOG)
        settings = settings.model_copy(update={"port": listener.getsockname()[1]})
        program = [sys.executable, "-m", "stickslip_workers"]
        if workers is not None:
            program = shlex.split(workers)
        coordinator = _coordinator(settings, lock, listener)
        children = [
            coordinator,
            _ray(data, program, slots),
            _dispatcher(settings, program, name),
        ]
        try:
            coordinator.start()
            if not _wait_until_ready(settings, coordinator, signals.stops):
                return 0
            # Other commands find the service by this file, so it appears when requests are
            # answered.
            write_durably(data / "url", f"{settings.url}\n".encode())
            on_ready(settings.url)
            # Ray and the dispatcher start here, like children that have died.
            _supervise(children, signals, settings)
            return 0
        finally:
            # The dispatcher stops first: it returns its leases to the coordinator.
            for child in reversed(children):
                child.stop(lambda: len(signals.stops) > 1)
            (data / "url").unlink(missing_ok=True)


def _supervise(children: list[Child], signals: Signals, settings: Settings) -> None:
    """Start children that have died, and rotate logs, until a signal to stop."""
    rotation = LogRotation(
        settings.log_bytes, DAY_SECONDS * settings.log_days, files=settings.log_files
    )
    next_look = 0.0
    while not signals.stops:
        for child in children:
            child.restart_if_dead()
        # Several SIGHUPs at once ask for one rotation.
        if signals.rotations:
            signals.rotations.clear()
            for child in children:
                rotation.rotate(child.log, time.time())
        elif time.monotonic() >= next_look:
            next_look = time.monotonic() + _ROTATION_SECONDS
            for child in children:
                rotation.rotate_if_due(child.log, time.time())
        time.sleep(_TICK_SECONDS)


def _child(name: str, data: Path, command: list[str]) -> Child:
    return Child(
        name,
        command,
        data / "logs" / f"{name}.log",
        start_seconds=FAILED_START_SECONDS[name],
        stop_seconds=STOP_SECONDS[name],
    )


def _coordinator(settings: Settings, lock: int, listener: socket.socket) -> Child:
    socket_number = listener.fileno()
    arguments = ["--data", str(settings.data), "--fd", str(socket_number)]
    command = [sys.executable, "-m", "stickslip_services.app", *arguments]
    child = _child("coordinator", settings.data, command)
    # The coordinator keeps the lock if the supervisor is killed, until it has ended.
    child.inherited = (lock, socket_number)
    child.private = settings.variables
    child.never_gives_up = True
    return child


def _ray(data: Path, program: list[str], slots: int | None) -> Child:
    command = [*program, "head", "--ray-data", str(data)]
    if slots is not None:
        command += ["--cpus", str(slots)]
    return _child("ray", data, command)


def _dispatcher(settings: Settings, program: list[str], name: str) -> Child:
    options = {
        "--ray-data": settings.data,
        "--url": settings.url,
        "--store": settings.store_place,
        "--name": name,
        "--key-file": settings.worker_key_path,
        "--tls-certificate": settings.tls_certificate,
    }
    command = [*program, "dispatch", "--once"]
    for option, value in options.items():
        if value is not None:
            command += [option, str(value)]
    return _child("dispatcher", settings.data, command)


def _wait_until_ready(settings: Settings, coordinator: Child, signals: list[int]) -> bool:
    """Return True when the coordinator answers, False after a signal to stop.

    Raise CommandError if it ends, or takes too long.
    """
    deadline = time.monotonic() + ANSWER_SECONDS
    # The certificate needs no check, because the supervisor owns the listening socket.
    with httpx.Client(base_url=settings.url, timeout=2.0, trust_env=False, verify=False) as client:
        while not signals:
            if coordinator.has_ended():
                log = coordinator.log_end()
                raise CommandError(f"the coordinator does not start:\n{log}")
            with suppress(httpx.TransportError):
                if client.get("/readyz").is_success:
                    return True
            if time.monotonic() > deadline:
                log = coordinator.log_end()
                raise CommandError(
                    f"the coordinator does not answer within {ANSWER_SECONDS:g} s:\n{log}"
                )
            time.sleep(_TICK_SECONDS / 2)
    return False


def _catch_signals() -> Signals:
    """Return the signals that arrive from now on, in lists that grow."""
    caught = Signals()
    message = (
        b"stopping; another Ctrl-C stops at once. Jobs go on when you start the service again\n"
    )

    def on_stop(number: int, _frame: FrameType | None) -> None:
        if not caught.stops:
            # The terminal may be gone.
            with suppress(OSError):
                os.write(2, message)
        caught.stops.append(number)

    def on_rotation(number: int, _frame: FrameType | None) -> None:
        caught.rotations.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_stop)
    signal.signal(signal.SIGHUP, on_stop if os.isatty(0) else on_rotation)
    return caught
