"""A process of `stickslip up`, which is restarted when it dies."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from stickslip_services.errors import CommandError
from stickslip_services.local.rotation import last_lines

MAX_FAILED_STARTS = 5
"""Failed starts in a row after which `stickslip up` gives up."""

FIRST_WAIT_SECONDS = 0.5
"""Wait before the start after the first failed one [s]; it doubles with each further one."""

MAX_WAIT_SECONDS = 30.0
"""Longest wait before a start [s]."""

POLL_SECONDS = 0.05
"""Time between two looks at a process that should stop [s]."""

LOG_LINES = 15
"""Lines of a log that an error shows."""

_PRIVATE = ("STICKSLIP_DATABASE", "STICKSLIP_SECRETS_KEY")
"""Variables with secrets that only the coordinator needs."""

_PR_SET_PDEATHSIG = 1  # of Linux's sys/prctl.h


@dataclass(slots=True)
class Child:
    """A process with a log, in a session of its own."""

    name: str
    command: list[str]
    log: Path
    start_seconds: float
    """A child that dies within this time of its start has failed to start [s]."""
    stop_seconds: float
    """Time that the child has to stop before it is killed [s]."""
    inherited: tuple[int, ...] = ()
    """File descriptors that the process gets."""
    private: dict[str, str] = field(default_factory=dict)
    """Variables for this process only."""
    never_gives_up: bool = False
    """Whether it is started again forever, since the others can go on without it."""
    process: subprocess.Popen[bytes] | None = None
    started_at: float = 0.0
    failed_starts: int = 0
    start_again_at: float = 0.0

    def start(self) -> None:
        """Start in a new session.

        Ctrl-C thus reaches only the supervisor, which stops its children in order.
        """
        public = {name: value for name, value in os.environ.items() if name not in _PRIVATE}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent,
                pass_fds=self.inherited,
                env=public | self.private,
            )
        self.started_at = time.monotonic()

    def restart_if_dead(self) -> None:
        """Restart the process if it has died; raise CommandError after too many failed starts."""
        if self.process is None:
            if time.monotonic() >= self.start_again_at:
                self.start()
            return
        if not self.has_ended():
            return
        # Its own children go with it.
        status = self._reap()
        lifetime = time.monotonic() - self.started_at
        # One that has run for a while may die and start again as often as it likes.
        if lifetime < self.start_seconds:
            self.failed_starts += 1
        else:
            self.failed_starts = 0
        outcome = f"exited with status {status}"
        if status < 0:
            outcome = f"was killed by signal {-status}"
        if self.failed_starts >= MAX_FAILED_STARTS and not self.never_gives_up:
            raise CommandError(
                f"the {self.name} {outcome}, for the {self.failed_starts}th time within "
                f"{self.start_seconds:g} s of its start. The end of {self.log}:\n{self.log_end()}"
            )
        self._schedule(outcome)

    def _schedule(self, outcome: str) -> None:
        """Set the time of the next start, and say in the terminal why the last one ended."""
        wait = 0.0
        if self.failed_starts > 0:
            wait = min(MAX_WAIT_SECONDS, FIRST_WAIT_SECONDS * 2 ** (self.failed_starts - 1))
        when = f"starting it again in {wait:g} s" if wait else "starting it again"
        reason = self.last_line()
        shown_reason = f" ({reason})" if reason else ""
        now = time.strftime("%H:%M:%S")
        sys.stderr.write(f"{now} the {self.name} {outcome}{shown_reason}; {when}\n")
        self.start_again_at = time.monotonic() + wait

    def stop(self, is_urgent: Callable[[], bool]) -> None:
        """Stop the process; kill it if it takes too long."""
        if self.process is None:
            return
        if not self.has_ended():
            self.process.terminate()
            deadline = time.monotonic() + self.stop_seconds
            while not self.has_ended() and time.monotonic() < deadline and not is_urgent():
                time.sleep(POLL_SECONDS)
        self._reap()

    def has_ended(self) -> bool:
        """Return whether the process has ended.

        It stays a zombie, because its pid names its group and must not be reused.
        """
        assert self.process is not None
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        return os.waitid(os.P_PID, self.process.pid, options) is not None

    def log_end(self) -> str:
        """Return the last lines of the log, indented."""
        lines = last_lines(self.log, LOG_LINES)
        return "\n".join(f"  {line}" for line in lines) or "  (empty)"

    def last_line(self) -> str:
        """Return the last line of the log that is not empty; an empty text without one."""
        lines = last_lines(self.log, 1)
        return lines[-1].strip()[:300] if lines else ""

    def _reap(self) -> int:
        """Kill the group of the process, and return its exit status.

        Processes that it left behind would block the next one.
        """
        assert self.process is not None
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        status = self.process.wait()
        self.process = None
        return status


def _die_with_parent() -> None:
    """Make the kernel end this process when the supervisor dies [prctl(2)]."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
