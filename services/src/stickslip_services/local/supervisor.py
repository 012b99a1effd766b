"""The processes on a machine: their memory, lock, socket and log, and `stickslip up`.

`stickslip up` runs a coordinator, a Ray and a dispatcher, restarted until the supervisor stops. All
files are below one directory: `coordinator.sqlite3`, `store/`, `logs/`, `url` (the address) and
`lock` (against a second supervisor). Children that die are restarted with growing delays. A child
that dies repeatedly at its start ends the supervisor, which prints the end of its log.
"""

import ctypes
import fcntl
import logging
import os
import shlex
import signal
import socket
import subprocess
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
from stickslip_services.settings import Settings

_M_ARENA_MAX = -8  # of glibc's malloc.h


def limit_arenas() -> None:
    """Let all threads allocate from two arenas of glibc.

    With one for each, every arena keeps memory that it freed.
    """
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


@contextmanager
def locked(data: Path) -> Iterator[int]:
    """Hold the lock of a data directory, which one coordinator or one `stickslip up` may use at a
    time.

    Yield the file descriptor of the lock. A process that inherits it holds the lock, too, until it
    ends. Raise DatabaseRefusedError if another process holds it.
    """
    data.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = data / "lock"
    with path.open("a+") as file:
        deadline = time.monotonic() + 10
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = path.read_text(encoding="utf-8").strip()
                # After a kill of `stickslip up`, its coordinator holds the lock for another moment.
                if Path("/proc", holder or "nobody").exists() or time.monotonic() > deadline:
                    message = f"{path.parent} is in use by another `stickslip up` or coordinator (pid {holder})"
                    raise DatabaseRefusedError(message) from None
                time.sleep(0.1)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield file.fileno()


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to a port, but does not accept connections yet; raise
    CommandError.
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


def configure_logging() -> None:
    """Log to standard error, one event a line: `time level logger: message`, in UTC."""
    formatter = logging.Formatter(
        "%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S"
    )
    formatter.converter = time.gmtime
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.getLogger("alembic").setLevel(logging.WARNING)


START_SECONDS = 180.0
"""Time limit for the coordinator's first answer [s]; migrations may be slow while simulations use
all cores.
"""
SOON_SECONDS = 5.0
"""A child that dies within this time of its start has failed to start [s]."""
MAX_FAILED_STARTS = 5
STOP_SECONDS = {"dispatcher": 6.0, "ray": 4.0, "coordinator": 4.0}
"""Time limit for each child to stop before it is killed [s]."""
_PRIVATE = ("STICKSLIP_DATABASE", "STICKSLIP_SECRETS_KEY")
"""Variables with secrets that only the coordinator needs."""
_TICK = 0.1
_PR_SET_PDEATHSIG = 1


@dataclass(slots=True)
class _Child:
    name: str
    command: list[str]
    log: Path
    inherited: tuple[int, ...] = ()
    private: dict[str, str] = field(default_factory=dict)
    """Variables for this process only."""
    process: subprocess.Popen[bytes] | None = None
    started_at: float = 0.0
    failed_starts: int = 0
    start_again_at: float = field(default=0.0)

    def start(self) -> None:
        """Start in a new session, so that Ctrl-C reaches only the supervisor, which stops children
        in order.
        """
        others = {name: value for name, value in os.environ.items() if name not in _PRIVATE}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent,
                pass_fds=self.inherited,
                env=others | self.private,
            )
        self.started_at = time.monotonic()

    def restart_if_dead(self) -> None:
        """Restart the process if it has died; raise CommandError after too many failed starts."""
        if self.process is None:
            if time.monotonic() >= self.start_again_at:
                self.start()
            return
        if not self._has_ended():
            return
        self._kill_group()  # its remaining processes would block the next one
        status = self.process.wait()
        self.process = None
        lived = time.monotonic() - self.started_at
        self.failed_starts = self.failed_starts + 1 if lived < SOON_SECONDS else 0
        how = f"was killed by signal {-status}" if status < 0 else f"exited with status {status}"
        if self.failed_starts >= MAX_FAILED_STARTS:
            raise CommandError(
                f"the {self.name} {how}, for the {self.failed_starts}th time within {SOON_SECONDS:g} s of its start. "
                f"The end of {self.log}:\n{self.last_words()}"
            )
        wait = 0.0 if self.failed_starts == 0 else 0.25 * 2**self.failed_starts
        again = f"starting it again in {wait:g} s" if wait else "starting it again"
        sys.stderr.write(f"{time.strftime('%H:%M:%S')} the {self.name} {how}; {again}\n")
        self.start_again_at = time.monotonic() + wait

    def stop(self, is_urgent: Callable[[], bool]) -> None:
        """Stop the process; kill it if it takes too long."""
        if self.process is None:
            return
        if not self._has_ended():
            self.process.terminate()
            deadline = time.monotonic() + STOP_SECONDS[self.name]
            while not self._has_ended() and time.monotonic() < deadline and not is_urgent():
                time.sleep(_TICK / 2)
        self._kill_group()
        self.process.wait()

    def last_words(self) -> str:
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return "(no log)"
        return "\n".join(f"  {line}" for line in lines[-15:]) or "  (empty)"

    def _has_ended(self) -> bool:
        """Return whether it has ended.

        It stays a zombie, because its pid names its group and must not be reused.
        """
        assert self.process is not None
        return (
            os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        )

    def _kill_group(self) -> None:
        assert self.process is not None
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


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
        lock = stack.enter_context(locked(data))
        signals = _stop_signals()
        # The supervisor owns the socket, so requests wait while the coordinator restarts.
        listener = stack.enter_context(listen(settings.host, settings.port))
        listener.listen(512)
        settings = settings.model_copy(update={"port": listener.getsockname()[1]})
        program = (
            [sys.executable, "-m", "stickslip_workers"] if workers is None else shlex.split(workers)
        )
        coordinator = _Child(
            "coordinator",
            [
                sys.executable,
                "-m",
                "stickslip_services.app",
                "--data",
                str(data),
                "--fd",
                str(listener.fileno()),
            ],
            data / "logs" / "coordinator.log",
            (lock, listener.fileno()),
            settings.variables,
        )
        head = [
            *program,
            "head",
            "--ray-data",
            str(data),
            *([] if slots is None else ["--cpus", str(slots)]),
        ]
        ray = _Child("ray", head, data / "logs" / "ray.log")
        places = {
            "--ray-data": data,
            "--url": settings.url,
            "--store": settings.store_place,
            "--name": name,
            "--key-file": settings.worker_key_path,
            "--tls-certificate": settings.tls_certificate,
        }
        words = [str(word) for place in places.items() if place[1] is not None for word in place]
        dispatcher = _Child(
            "dispatcher", [*program, "dispatch", "--once", *words], data / "logs" / "dispatcher.log"
        )
        children = [coordinator, ray, dispatcher]
        try:
            coordinator.start()
            if not _wait_until_ready(settings, coordinator, signals):
                return 0
            write_durably(data / "url", f"{settings.url}\n".encode())
            ray.start()
            dispatcher.start()
            on_ready(settings.url)
            while not signals:
                for child in children:
                    child.restart_if_dead()
                time.sleep(_TICK)
            return 0
        finally:
            for child in reversed(children):  # the dispatcher first, which returns its leases
                child.stop(lambda: len(signals) > 1)
            (data / "url").unlink(missing_ok=True)


def _wait_until_ready(settings: Settings, coordinator: _Child, signals: list[int]) -> bool:
    """Return True when the coordinator answers, False after a signal to stop; raise CommandError."""
    deadline = time.monotonic() + START_SECONDS
    # The certificate needs no check, because the supervisor owns the listening socket.
    with httpx.Client(base_url=settings.url, timeout=2.0, trust_env=False, verify=False) as client:
        while not signals:
            assert coordinator.process is not None
            if coordinator.process.poll() is not None:
                raise CommandError(f"the coordinator does not start:\n{coordinator.last_words()}")
            try:
                if client.get("/readyz").is_success:
                    return True
            except httpx.TransportError:
                pass
            if time.monotonic() > deadline:
                raise CommandError(
                    f"the coordinator does not answer within {START_SECONDS:g} s:\n{coordinator.last_words()}"
                )
            time.sleep(_TICK / 2)
    return False


def _stop_signals() -> list[int]:
    """Return a list of the numbers of the signals to stop, which grows as they come."""
    caught: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if not caught:
            os.write(
                2,
                b"stopping; another Ctrl-C stops at once. Jobs go on when you start the service again\n",
            )
        caught.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    return caught


def _die_with_parent() -> None:
    """Make the kernel end this process when the supervisor dies [prctl(2)]."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
