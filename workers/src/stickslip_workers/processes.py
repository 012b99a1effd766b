"""Processes that run tasks: Ray actors of two sorts, one for the stages and one, in Blender's interpreter, to render.

Actors rather than Ray tasks for both: a process that has described itself is known to be there, so a task given to it
has started, its time limit is fair, and work that Ray cannot place anywhere shows as a process that does not start.
"""

import contextlib
import logging
import os
import signal
import time
from dataclasses import dataclass, field
from typing import Any

from stickslip_workers import host

log = logging.getLogger(__name__)

_STARTS = 3
"""Processes in a row that may fail to start before the pool gives up."""


WORTH_SECONDS = 2.0
"""Work waits so long for a busy process, all waits together, before another process is started: about what it costs to
start one."""


class StartError(RuntimeError):
    """Processes of a pool do not start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoolSettings:
    """What the processes of a pool are."""

    sort: str
    factory: str
    """`module:Class` of what each process holds, see `Host`."""
    store: str
    size: int
    num_cpus: float
    """Ray's share for one process. Those of all pools fit into the cluster together, so that none starves."""
    start_seconds: float
    tasks_per_process: int
    process_bytes: int
    python: str | None = None
    """Another interpreter than this one."""
    environment: dict[str, str] = field(default_factory=dict)
    """Variables that each process gets besides those of the cluster."""
    num_gpus: float = 0.0
    """GPUs that each process has for itself."""
    tells_frames: bool = False
    """Whether a process can be asked how far it is while it works: it then has a second thread."""


@dataclass(eq=False)
class Process:
    """One process."""

    actor: Any
    described: Any
    """Ray's reference to its description, which is there when the process has started."""
    started_at: float = field(default_factory=time.monotonic)
    pid: int = 0
    node: str = ""
    """Id of the node that it runs on."""
    tasks: int = 0


class Pool:
    """Processes of one sort. Those that end are replaced when there is work."""

    def __init__(self, settings: PoolSettings) -> None:
        self._settings = settings
        self._starting: list[Process] = []
        self._idle: list[Process] = []
        self._busy: set[Process] = set()
        self._failed_starts = 0
        self._short_since: float | None = None
        self._waited = 0.0
        """How long work has waited for a process that was busy since the pool last grew [s]."""
        self.description: dict[str, Any] | None = None
        """What the first process said about itself; all others must say the same."""

    @property
    def size(self) -> int:
        """Number of processes, whatever they do."""
        return len(self._starting) + len(self._idle) + len(self._busy)

    def waiting_refs(self) -> list[Any]:
        """Return the references that tell when processes have started."""
        return [process.described for process in self._starting]

    def grow(self, count: int) -> None:
        """Start processes until `count` are starting or idle, or the pool is full."""
        while len(self._starting) + len(self._idle) < count and self.size < self._settings.size:
            self._starting.append(self._start())

    def grow_if_worth(self, count: int) -> None:
        """Grow, `count` calls having to wait: at once where there is no process, else when they have waited for long.

        Short tasks are done sooner by the processes that there are than by one that has to be started.
        """
        now = time.monotonic()
        if self._short_since is not None:
            self._waited += now - self._short_since
        self._short_since = now if count > 0 else None
        if count > 0 and (self.size == 0 or self._waited > WORTH_SECONDS):
            self._waited = 0.0
            self.grow(count)

    def take(self) -> Process | None:
        """Take an idle process."""
        if not self._idle:
            return None
        process = self._idle.pop()
        self._busy.add(process)
        return process

    def give_back(self, process: Process, resident: int, tasks: int) -> None:
        """Return a process after some tasks; an old or fat one is replaced."""
        process.tasks += tasks
        if process.tasks >= self._settings.tasks_per_process or resident > self._settings.process_bytes:
            log.info("%s: process %d retires (%d bytes)", self._settings.sort, process.pid, resident)
            self.end(process)
            self.grow(1)
        else:
            self._busy.discard(process)
            self._idle.append(process)

    def end(self, process: Process) -> None:
        """Kill a process."""
        import ray

        self._busy.discard(process)
        ray.kill(process.actor, no_restart=True)
        if process.pid and process.node == ray.get_runtime_context().get_node_id():
            # Ray asks a process to end, and one that was stopped does not listen.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(process.pid, signal.SIGKILL)

    def note_death(self, process: Process) -> None:
        """Note that a busy process has died. A lost node may have taken others with it: ask the idle ones."""
        self._busy.discard(process)
        for idle in self._idle:
            idle.described = idle.actor.describe.remote()
            idle.started_at = time.monotonic()
        self._starting += self._idle
        self._idle = []

    def close(self) -> None:
        """Kill all processes: one that is at work would not end by itself."""
        for process in [*self._starting, *self._idle, *self._busy]:
            self.end(process)
        self._starting, self._idle = [], []

    def check_starts(self) -> None:
        """Take in the processes that have started; raise StartError when they do not."""
        import ray

        if not self._starting:
            return
        refs = self.waiting_refs()
        ready, _ = ray.wait(refs, num_returns=len(refs), timeout=0)
        starting, self._starting = self._starting, []
        for process in starting:
            if process.described in ready:
                self._welcome(process)
            elif time.monotonic() > process.started_at + self._settings.start_seconds:
                raise StartError(
                    f"no {self._settings.sort} process could be started within {self._settings.start_seconds:g} s; "
                    f"each needs {self._settings.num_cpus:g} CPUs and {self._settings.num_gpus:g} GPUs, and the "
                    f"cluster has free {ray.available_resources()}"
                )
            else:
                self._starting.append(process)

    def _start(self) -> Process:
        import ray

        ray.cloudpickle.register_pickle_by_value(host)
        runtime_env: dict[str, Any] = {"env_vars": {"OMP_NUM_THREADS": "1", **self._settings.environment}}
        if self._settings.python is not None:
            runtime_env["py_executable"] = self._settings.python
        actor_class = ray.remote(
            num_cpus=self._settings.num_cpus,
            num_gpus=self._settings.num_gpus,
            max_restarts=0,
            max_task_retries=0,
            max_concurrency=2 if self._settings.tells_frames else 1,
            scheduling_strategy="SPREAD",
            runtime_env=runtime_env,
        )(host.Host)
        actor = actor_class.remote(self._settings.factory, self._settings.store)
        return Process(actor=actor, described=actor.describe.remote())

    def _welcome(self, process: Process) -> None:
        import ray

        try:
            description = ray.get(process.described)
        except ray.exceptions.RayError as error:
            if process.pid:  # it had been started: see `note_death`
                return
            self._failed_starts += 1
            log.error("%s: a process did not start: %s", self._settings.sort, error)
            if self._failed_starts >= _STARTS:
                raise StartError(
                    f"{_STARTS} {self._settings.sort} processes in a row did not start: {error}"
                ) from error
            return
        process.pid, process.node = description.pop("pid"), description.pop("node")
        if self.description is None:
            self.description = description
        elif description != self.description:
            self.end(process)
            raise StartError(
                f"every {self._settings.sort} process must be of one build; "
                f"process {process.pid} is {description}, and others are {self.description}"
            )
        self._failed_starts = 0
        self._idle.append(process)
