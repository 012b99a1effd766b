"""`stickslip up`: a coordinator, a Ray and a dispatcher on this machine, restarted until the supervisor stops.

All files are below one directory: `coordinator.sqlite3`, `store/`, `logs/`, `url` (the address) and `lock` (against a
second supervisor). Children that die are restarted with growing delays. A child that dies repeatedly at its start ends
the supervisor, which prints the end of its log.
"""

import ctypes
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

from stickslip_services.addresses import DATABASE_VARIABLE, PRIVATE_VARIABLES
from stickslip_services.errors import SupervisorError
from stickslip_services.local.process import listen, locked
from stickslip_services.settings import Settings

START_SECONDS = 180.0
"""Time limit for the coordinator's first answer [s]; migrations may be slow while simulations use all cores."""
SOON_SECONDS = 5.0
"""A child that dies within this time of its start has failed to start [s]."""
MAX_FAILED_STARTS = 5
STOP_SECONDS = {"dispatcher": 6.0, "ray": 4.0, "coordinator": 4.0}
"""Time limit for each child to stop before it is killed [s]."""
_TICK = 0.1
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, slots=True)
class LocalService:
    """Settings of `stickslip up`."""

    settings: Settings
    """Of the coordinator. `data` is an absolute path."""
    name: str = "local"
    """Name of the dispatcher among all that have the same database."""
    slots: int | None = None
    workers: str | None = None
    """Another command than `python -m stickslip_workers`, for tests."""


@dataclass(slots=True)
class _Child:
    name: str
    command: list[str]
    log: Path
    inherited: tuple[int, ...] = ()
    private: dict[str, str] = field(default_factory=dict)
    """Variables with secrets, for this process only."""
    process: subprocess.Popen[bytes] | None = None
    started_at: float = 0.0
    failed_starts: int = 0
    start_again_at: float = field(default=0.0)

    def start(self) -> None:
        """Start in a new session, so that Ctrl-C reaches only the supervisor, which stops children in order."""
        others = {name: value for name, value in os.environ.items() if name not in PRIVATE_VARIABLES}
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
        """Restart the process if it has died; raise SupervisorError after too many failed starts."""
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
            raise SupervisorError(
                f"the {self.name} {how}, for the {self.failed_starts}th time within {SOON_SECONDS:g} s of its start. "
                f"The end of {self.log}:\n{self.last_words()}"
            )
        wait = 0.0 if self.failed_starts == 0 else 0.25 * 2**self.failed_starts
        _say(f"the {self.name} {how}; starting it again" + (f" in {wait:g} s" if wait else ""))
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
        """Return the end of the log."""
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return "(no log)"
        return "\n".join(f"  {line}" for line in lines[-15:]) or "  (empty)"

    def _has_ended(self) -> bool:
        """Return whether it has ended. It stays a zombie, because its pid names its group and must not be reused."""
        assert self.process is not None
        return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def _kill_group(self) -> None:
        assert self.process is not None
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


def run(service: LocalService, *, on_ready: Callable[[str], None]) -> int:
    """Run until a signal to stop; return the exit status. Raise SupervisorError."""
    settings = service.settings
    data = settings.data
    (data / "logs").mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        lock = stack.enter_context(locked(data))
        signals = stack.enter_context(_stop_signals())
        # The supervisor owns the socket, so requests wait while the coordinator restarts.
        listener = _listen(settings.host, settings.port)
        stack.callback(listener.close)
        settings = settings.model_copy(update={"port": listener.getsockname()[1]})
        coordinator = _Child(
            "coordinator",
            _coordinator_command(settings, listener.fileno()),
            data / "logs" / "coordinator.log",
            (lock, listener.fileno()),
            {name: os.environ[name] for name in PRIVATE_VARIABLES if name in os.environ}
            | ({} if settings.database is None else {DATABASE_VARIABLE: settings.database.get_secret_value()}),
        )
        ray = _Child("ray", _ray_command(service, data), data / "logs" / "ray.log")
        dispatcher = _Child("dispatcher", _dispatcher_command(service, settings), data / "logs" / "dispatcher.log")
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


def _say(message: str) -> None:
    """Write a line with the time on standard error."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {message}\n")


def _coordinator_command(settings: Settings, listener: int) -> list[str]:
    module = "stickslip_services.app"
    place = ["--data", str(settings.data), "--host", settings.host, "--port", str(settings.port), "--fd", str(listener)]
    place += [] if settings.store is None else ["--store", settings.store]
    auth = [f"--allow-host={host}" for host in settings.allowed_hosts]
    auth += ["--require-keys"] if settings.require_keys else []
    auth += ["--behind-proxy"] if settings.behind_proxy else []
    if settings.tls_certificate is not None:
        auth += ["--tls-certificate", str(settings.tls_certificate), "--tls-key", str(settings.tls_key)]
    auth += [] if settings.signing_key is None else ["--signing-key", str(settings.signing_key)]
    return [sys.executable, "-m", module, *place, *auth]


def _workers_program(service: LocalService) -> list[str]:
    return [sys.executable, "-m", "stickslip_workers"] if service.workers is None else shlex.split(service.workers)


def _ray_command(service: LocalService, data: Path) -> list[str]:
    slots = [] if service.slots is None else ["--cpus", str(service.slots)]
    return [*_workers_program(service), "head", "--ray-data", str(data), *slots]


def _dispatcher_command(service: LocalService, settings: Settings) -> list[str]:
    pinned = [] if settings.tls_certificate is None else ["--tls-certificate", str(settings.tls_certificate)]
    return [
        *_workers_program(service),
        "dispatch",
        "--once",
        "--ray-data",
        str(settings.data),
        "--url",
        settings.url,
        "--store",
        settings.store_place,
        "--name",
        service.name,
        "--key-file",
        str(settings.worker_key_path),
        *pinned,
    ]


def _wait_until_ready(settings: Settings, coordinator: _Child, signals: list[int]) -> bool:
    """Return True when the coordinator answers, False after a signal to stop; raise SupervisorError."""
    deadline = time.monotonic() + START_SECONDS
    # The certificate needs no check, because the supervisor owns the listening socket.
    with httpx.Client(base_url=settings.url, timeout=2.0, trust_env=False, verify=False) as client:
        while not signals:
            assert coordinator.process is not None
            if coordinator.process.poll() is not None:
                raise SupervisorError(f"the coordinator does not start:\n{coordinator.last_words()}")
            try:
                if client.get("/readyz").is_success:
                    return True
            except httpx.TransportError:
                pass
            if time.monotonic() > deadline:
                raise SupervisorError(
                    f"the coordinator does not answer within {START_SECONDS:g} s:\n{coordinator.last_words()}"
                )
            time.sleep(_TICK / 2)
    return False


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """Collect the numbers of the signals to stop."""
    caught: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if not caught:
            os.write(2, b"stopping; another Ctrl-C stops at once. Jobs go on when you start the service again\n")
        caught.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _listen(host: str, port: int) -> socket.socket:
    try:
        listener = listen(host, port)
    except OSError as error:
        raise SupervisorError(
            f"cannot listen on {host}:{port}: {error.strerror}. `--port 0` takes any free port."
        ) from error
    listener.listen(512)
    listener.set_inheritable(True)
    return listener


def _die_with_parent() -> None:
    """Make the kernel end this process when the supervisor dies [prctl(2)]."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
