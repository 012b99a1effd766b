"""Runs a scene on an adapter in a process of its own, and says why if that fails."""

import math
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import numpy as np

from stickslip_measure import wire
from stickslip_measure.contract import Floats, Rod, Sheet

HOST = Path(__file__).with_name("host.py")

FRAMES_AT_ONCE = 16
"""Steps in a request."""

PATIENCE = 0.5
"""Share of the time limit that a single answer may take: an import, a set-up or a step.

A scene has more steps than two, so it could not end in time with such a step.
"""

STUCK = 100.0
"""Time of a step over that of the longest step before, from which on it does not end.

It decides only when the time limit is over, between a simulator that is slow and one that hangs.
"""

STUCK_LEAST = 1.0
"""Least time of such a step [s]: a busy machine may delay any step."""

LOG_LINES = 3
"""Number of last lines of a crashed process that its reason quotes."""

LOG_LENGTH = 240
"""Most characters of them."""

LARGEST = 1e6
"""Positions beyond this are no result of a scene of some centimetres [m]."""


class AdapterError(Exception):
    """Why a cell has no number. The message is printed."""

    state: ClassVar[str]


class SetupError(AdapterError):
    """The scene could not be set up: nothing is known about the physics."""

    state = "could not be set up"


class StepError(AdapterError):
    """A step raised an exception."""

    state = "failed"


class CrashError(AdapterError):
    """The process ended."""

    state = "crashed"


class HangError(AdapterError):
    """A step, a set-up or an import did not end."""

    state = "hangs"


class SlowError(AdapterError):
    """The time limit was over before the scene was."""

    state = "not finished"


class NotFiniteError(AdapterError):
    """Positions are NaN, infinite or far away."""

    state = "not finite"


class ContractError(AdapterError):
    """The adapter breaks the contract."""

    state = "breaks the contract"


@dataclass(frozen=True)
class Program:
    """An adapter and the interpreter that runs it."""

    adapter: Path
    python: str = sys.executable
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))


@dataclass(frozen=True)
class Description:
    """The description that an adapter gives of itself; contract.py has the meanings."""

    name: str
    version: str
    capabilities: frozenset[str]
    settings: Mapping[str, Mapping[str, Any]]
    clearance: float
    gap: float
    damps: bool
    python: str
    numpy: str
    sources: Mapping[str, str] = field(default_factory=dict)
    """Digests of the files that its import loads and that are not installed, by path."""


class LateError(Exception):
    """An answer does not come in time."""


class AdapterProcess:
    """The process of an adapter. Close it, or use it as a context.

    Args:
        program: Adapter and interpreter.
        log: File for everything that the process prints.
        seconds: Time limit of the whole process [s].
        budget: Limit of its CPU time [s], which does not depend on other programs.
        patience: Share of `seconds` that a step may take. Imports and constructors have
            `PATIENCE`.
    """

    def __init__(
        self,
        program: Program,
        log: Path,
        seconds: float,
        budget: float = math.inf,
        patience: float = PATIENCE,
    ) -> None:
        self.log = log
        self.seconds = seconds
        self.budget = budget
        self.patience = patience * seconds
        """Longest time of a step [s]."""
        now = time.monotonic()
        self.deadline = now + seconds
        self.cpu = 0.0
        """CPU time of the process at its last reply [s]."""
        self.sources: dict[str, str] = {}
        """Digests of the files that it imported and that are not installed, by path."""
        self.steps = 0
        """Steps that have ended."""
        self.longest = 0.0
        """Time of the longest of them [s]."""
        self._begun = now
        """When the last wait began: for a step, or for another answer."""
        self._longest_wait = PATIENCE * seconds
        with log.open("wb") as output:
            try:
                self._process = subprocess.Popen(
                    [program.python, str(HOST), str(program.adapter.resolve())],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=output,
                    env=dict(program.environment),
                    # Its children end with it.
                    start_new_session=True,
                )
            except OSError as error:
                raise SetupError(f"{program.python} does not start: {error.strerror}") from error
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests = self._process.stdin
        self._replies = self._process.stdout
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._replies, selectors.EVENT_READ)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process and its children."""
        self._selector.close()
        # It may still compute, and nobody waits for the result.
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._replies.close()
        try:
            self._requests.close()
        except BrokenPipeError:
            # A process that has ended does not read the last request.
            return

    def request(
        self, header: dict[str, Any], arrays: list[wire.Array], failure: type[AdapterError]
    ) -> wire.Message:
        """Return the reply to a request.

        Raises:
            AdapterError: `failure` for an exception of the adapter; or the process crashed.
            LateError: An answer did not come in time.
        """
        self._begun = time.monotonic()
        stepping = header["verb"] == "advance"
        self._longest_wait = self.patience if stepping else PATIENCE * self.seconds
        try:
            self._requests.write(wire.encoded(header, arrays))
            self._requests.flush()
        except BrokenPipeError:
            # The reason follows from how the process has ended.
            raise self._crash() from None
        reply, results = wire.read_message(self._read)
        while not self._is_last(reply):
            reply, results = wire.read_message(self._read)
        self.cpu = float(reply.pop("cpu"))
        self.sources.update(reply.pop("sources"))
        if "error" in reply:
            raise failure(reply["error"])
        return reply, results

    @property
    def waited(self) -> float:
        """Time since the last step ended, or since the request [s]."""
        return time.monotonic() - self._begun

    @property
    def waited_text(self) -> str:
        """The time that was waited, as a message has it: a busy machine notices its limit late."""
        return f"{min(round(self.waited, 1), self._longest_wait):g}"

    @property
    def is_stuck(self) -> bool:
        """Whether the answer that is late does not come at all, as far as one can tell."""
        limit = max(STUCK * self.longest, STUCK_LEAST) if self.steps else math.inf
        return self.waited >= min(self.patience, limit)

    def _is_last(self, message: Mapping[str, Any]) -> bool:
        """Return whether a message is the answer to the request, and note it if it is not."""
        if "ended" in message:
            self._count_step()
            return False
        if "imports" in message:
            self.sources.update(message["imports"])
            return False
        return True

    def _count_step(self) -> None:
        self.longest = max(self.longest, self.waited)
        self.steps += 1
        self._begun = time.monotonic()

    def _read(self, size: int) -> bytes:
        parts = bytearray()
        while len(parts) < size:
            left = min(self.deadline, self._begun + self._longest_wait) - time.monotonic()
            if left <= 0.0 or not self._selector.select(left):
                raise LateError
            part = os.read(self._replies.fileno(), size - len(parts))
            # An open pipe has something to read, so this one has been closed.
            if not part:
                raise self._crash()
            parts += part
        return bytes(parts)

    def _crash(self) -> CrashError:
        code = self._process.wait()
        ending = f"exit code {code}"
        if code < 0:
            ending = f"signal {signal.Signals(-code).name}"
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        printed = " | ".join(lines[-LOG_LINES:])[-LOG_LENGTH:]
        return CrashError(f"{ending}, printed: {printed}" if printed else ending)


def describe(program: Program, log: Path, seconds: float) -> Description:
    """Return the description that an adapter gives of itself.

    Raises:
        AdapterError: It cannot be imported, or lacks an attribute.
    """
    with AdapterProcess(program, log, seconds) as process:
        return replace(_described(process), sources=process.sources)


def _described(process: AdapterProcess) -> Description:
    try:
        reply, _ = process.request({"verb": "describe"}, [], SetupError)
    except LateError as error:
        raise HangError(f"its import did not end within {process.waited_text} s") from error
    return Description(**{**reply, "capabilities": frozenset(reply["capabilities"])})


class Simulation:
    """A scene that runs on an adapter.

    Args:
        process: A fresh process.
        scene: The scene.
        setting: Row of the adapter's settings.

    Raises:
        AdapterError: The scene could not be set up, or breaks the contract.
    """

    def __init__(self, process: AdapterProcess, scene: Sheet | Rod, setting: str) -> None:
        self._process = process
        self.scene = scene
        self.adapter = _described(process)
        header, arrays = wire.from_scene(scene)
        request = {"verb": "start", "scene": header, "setting": setting}
        try:
            reply, (positions,) = process.request(request, arrays, SetupError)
        except LateError as error:
            raise HangError(
                f"its constructor did not end within {process.waited_text} s"
            ) from error
        self.frame = float(reply["frame"])
        """Time of a step [s]."""
        self.time = 0.0
        """Scene time that has passed [s]."""
        self.damping: float | None = None
        """Rate at which velocities decay [1/s]. None leaves them to the simulator."""
        self.positions = positions
        """Positions after the last step: (V, 3) [m]."""
        vertices = len(scene.start) if isinstance(scene, Sheet) else scene.elements + 1
        if not (np.isfinite(self.frame) and self.frame > 0.0):
            raise ContractError(f"frame: must be finite and > 0 s, got {self.frame}")
        if positions.shape != (vertices, 3):
            raise ContractError(
                f"positions: must have shape ({vertices}, 3), got {positions.shape}"
            )
        _check_finite(positions, self.time)

    def frames_in(self, seconds: float) -> int:
        """Return the number of steps in a time, at least 1."""
        return max(1, round(seconds / self.frame))

    def times(self, steps: int) -> Floats:
        """Return the ends of so many steps, from a start at 0: (N,) [s]."""
        return np.asarray(self.frame * np.arange(1, steps + 1), dtype=np.float64)

    def settle_gently(self, rate: float) -> None:
        """Let velocities decay from now on, if the simulator can, or not any more for a rate of 0.

        Args:
            rate: Rate of the decay [1/s].
        """
        if self.adapter.damps:
            self.damping = rate

    def advance(self, gravity: Floats) -> Floats:
        """Take N steps with the gravity of each (N, 3) [m/s^2]; return positions (N, V, 3) [m].

        Raises:
            AdapterError: A step failed, or the time limit is over.
        """
        parts = []
        for begin in range(0, len(gravity), FRAMES_AT_ONCE):
            batch = np.ascontiguousarray(gravity[begin : begin + FRAMES_AT_ONCE], dtype=float)
            parts.append(self._advance(batch))
        return np.concatenate(parts)

    def _advance(self, batch: Floats) -> Floats:
        request = {"verb": "advance", "damping": self.damping}
        try:
            _, (frames,) = self._process.request(request, [batch], StepError)
        except LateError as error:
            raise self._late() from error
        self.time += len(batch) * self.frame
        shape = (len(batch), *self.positions.shape)
        if frames.shape != shape:
            raise ContractError(f"positions: must have shape {shape[1:]}, got {frames.shape[1:]}")
        _check_finite(frames, self.time)
        self.positions = frames[-1]
        if self._process.cpu > self._process.budget:
            raise SlowError(
                "the limit of CPU time (--budget) was reached when the scene was at "
                f"{self.time:.3g} s, after {self._process.steps} steps"
            )
        return np.asarray(frames)

    def _late(self) -> HangError | SlowError:
        """Return why a step is late: it does not end, or all steps together take too long."""
        steps = self._process.steps
        place = f"{steps * self.frame:.3g} s"
        if self._process.is_stuck:
            longest = f"; the longest step before it took {self._process.longest:.2g} s"
            return HangError(
                f"step {steps + 1} of the scene, which begins at {place}, did not end within "
                f"{self._process.waited_text} s{longest if steps else ''}"
            )
        return SlowError(
            f"the time limit of {self._process.seconds:g} s (--timeout) was over when the scene "
            f"was at {place}, after {steps} steps"
        )

    def rest(self, seconds: float, gravity: Floats) -> Floats:
        """Advance by a time under constant gravity (3,); return positions (N, V, 3) [m]."""
        return self.advance(np.tile(gravity, (self.frames_in(seconds), 1)))


def _check_finite(positions: Floats, time: float) -> None:
    if not np.isfinite(positions).all():
        raise NotFiniteError(f"a position is NaN or infinite at {time:.3g} s")
    if np.abs(positions).max() > LARGEST:
        raise NotFiniteError(f"a position is beyond {LARGEST:g} m at {time:.3g} s")
