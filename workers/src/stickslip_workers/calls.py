"""Calls: the tasks of Ray that this dispatcher has given to a cluster."""

import logging
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from stickslip_schemas.base.states import Stage
from stickslip_schemas.documents.worker_api import Lease

from stickslip_workers import call, cluster
from stickslip_workers.batches import Parts, arguments_of, limit_of
from stickslip_workers.memory import memory_bytes
from stickslip_workers.settings import CPU, RENDER_DEVICE, Settings

log = logging.getLogger(__name__)

LOOK_SECONDS = 2.0
"""Time between two looks at the nodes of the cluster [s]."""

AHEAD_SHARE, LEAST_AHEAD = 0.5, 4
"""Calls that wait in Ray: so many for each CPU, and so many at least. An autoscaler adds nodes for what waits."""

WARM_UP_SECONDS = 10.0
"""The first tasks wait so long for processes to start [s]."""

CALLS_PER_PROCESS = 1000
"""Calls after which a process gives way to a fresh one: Blender's memory grows slowly."""

STAGES = "stickslip_workers.stages.run:StageActor"


class LostError(RuntimeError):
    """The node of a call is gone."""


class NotDoneError(RuntimeError):
    """Nothing of a call was done, and it must be given again."""


class NoNodeError(RuntimeError):
    """All nodes of the cluster have other builds than the dispatcher."""


@dataclass(eq=False)
class Call:
    """A task of Ray, which does tasks of one stage."""

    parts: Parts
    stage: Stage
    limit: float
    """It is cancelled after this time [s]."""
    given_at: float
    is_express: bool
    started_at: float | None = None
    node: str = ""
    is_first: bool = False
    """Whether it is the first one of its process."""
    cancelled: str = ""
    """Why, where it has been."""
    unwanted_since: float | None = None

    @property
    def leases(self) -> list[Lease]:
        return list(chain.from_iterable(self.parts))

    def runs_longer_than(self, seconds: float) -> bool:
        """Return whether it started so long ago."""
        return self.started_at is not None and time.monotonic() > self.started_at + seconds


class Calls:
    """The calls of a driver of Ray, which must be connected. `builds` are those of the stages and of the renderer."""

    def __init__(self, settings: Settings, builds: Mapping[bool, Mapping[str, Any]]) -> None:
        import ray

        self._settings = settings
        self._builds = builds
        self._calls: dict[Any, Call] = {}
        self._foreign: set[str] = set()
        self._warm: set[str] = set()
        """Nodes on which processes were started."""
        self._next_look = 0.0
        self.cpus = 0.0
        """CPUs that calls may use, of the nodes that are there now."""
        ray.cloudpickle.register_pickle_by_value(call)
        common = {"max_retries": 0, "num_returns": "streaming", "max_calls": CALLS_PER_PROCESS}
        environment = {"OMP_NUM_THREADS": "1", RENDER_DEVICE: settings.render_device}
        python = str(settings.blender_python)
        gpus = 0 if settings.render_device == CPU else settings.render_gpus
        self._remote: dict[bool, Any] = {
            False: ray.remote(**common, runtime_env={"env_vars": environment})(call.run),
            True: ray.remote(**common, num_gpus=gpus, runtime_env={"env_vars": environment, "py_executable": python})(
                call.run
            ),
        }
        list(self._look())
        if self._calls:  # tasks that come while processes start would start more
            ray.wait(list(self._calls), num_returns=len(self._calls), timeout=WARM_UP_SECONDS)

    def __iter__(self) -> Iterator[Call]:
        return iter(list(self._calls.values()))

    def room(self, *, is_long: bool) -> int:
        """Return how many more calls to give to Ray; of long ones fewer wait, for other dispatchers may be idle."""
        ahead = max(AHEAD_SHARE * self.cpus, 1 if is_long else LEAST_AHEAD)
        room = math.ceil(self.cpus + ahead) if self._settings.max_cpus is None else self._settings.max_cpus
        return room - sum(not one.is_express for one in self._calls.values())

    def is_clogged(self) -> bool:
        """Return whether all CPUs have been taken for long."""
        long = sum(one.runs_longer_than(self._settings.clog_seconds) and not one.is_express for one in self)
        return 0 < self.cpus <= long

    def give(self, parts: Parts, stage: Stage, *, is_express: bool = False, node: str = "") -> None:
        """Give a call to Ray, without tasks only to start a process. An express one needs no free CPU."""
        renders = stage is Stage.render
        settings = self._settings
        options: dict[str, Any] = {"num_cpus": 0 if is_express else 1, "memory": memory_bytes(stage, parts)}
        if node or self._foreign:
            options["label_selector"] = {"ray.io/node-id": node or f"!in({','.join(sorted(self._foreign))})"}
        reference = (
            self._remote[renders]
            .options(name=stage.value if parts else "warm-up", **options)
            .remote(
                settings.render_actor if renders else STAGES,
                settings.store,
                self._builds[renders],
                "render" if renders else "run",
                arguments_of(parts) if parts else [],
                stage is Stage.simulate and len(parts) == 1 and len(parts[0]) == 1,
            )
        )
        limit = limit_of(parts, settings.exec_seconds[stage])
        self._calls[reference] = Call(parts, stage, limit, time.monotonic(), is_express)

    def collect(self, timeout: float) -> Iterator[tuple[Call, Any]]:
        """Wait for news; yield calls that have started with None, with frames done and in all, or at their end with
        the list of their answers or an exception.
        """
        import ray

        if time.monotonic() >= self._next_look:
            yield from self._look()
        if not self._calls:
            time.sleep(timeout)
            return
        ready, _ = ray.wait(list(self._calls), num_returns=1, timeout=timeout)
        if ready:
            ready, _ = ray.wait(list(self._calls), num_returns=len(self._calls), timeout=0)
        for reference in ready:
            one = self._calls[reference]
            try:
                said = ray.get(next(reference))
            except ray.exceptions.LocalRayletDiedError:  # no call of this driver can end well any more
                raise
            except ray.exceptions.RayError as error:
                said = error
            if isinstance(said, dict):
                one.started_at, one.node, one.is_first = time.monotonic(), said["node"], said["first"]
                if said["foreign"]:
                    self._exclude(one.node)
                said = NotDoneError(f"{one.node} is foreign") if said["foreign"] else None
            if isinstance(said, list | Exception):
                del self._calls[reference]
            if one.parts:
                yield one, said
            elif isinstance(said, ray.exceptions.RayTaskError):
                raise said

    def cancel(self, one: Call, why: str) -> None:
        """End a call; `collect` yields it once more."""
        import ray

        one.cancelled = why
        ray.cancel(next(reference for reference, it in self._calls.items() if it is one), force=True)

    def forget(self, one: Call) -> None:
        """End a call of which `collect` says nothing any more."""
        self.cancel(one, "not wanted")
        self._calls = {reference: it for reference, it in self._calls.items() if it is not one}

    def _look(self) -> Iterator[tuple[Call, Any]]:
        """Look which nodes are alive: Ray may wait forever for a call on a lost one, also if it has not said where."""
        nodes = cluster.nodes()
        cpus = sum(node["Resources"].get("CPU", 0) for name, node in nodes.items() if name not in self._foreign)
        self.cpus = min(cpus, self._settings.max_cpus or math.inf)
        self._next_look = time.monotonic() + LOOK_SECONDS
        for name in nodes.keys() - self._warm:  # its first tasks should not have to wait for Blender
            self._warm.add(name)
            for _ in range(min(int(nodes[name]["Resources"].get("CPU", 0)), self._settings.max_cpus or sys.maxsize)):
                for stage in (Stage.simulate, Stage.render):
                    self.give([], stage, is_express=True, node=name)
        lost = self._warm - nodes.keys()
        self._warm -= lost
        for reference, one in list(self._calls.items()):
            if one.node and one.node not in nodes:
                del self._calls[reference]
                yield one, LostError(f"node {one.node} is gone")
            elif lost and one.started_at is None:
                self.forget(one)
                yield one, NotDoneError(f"it may be on node {min(lost)}, which is gone")
        working = {name for name, node in nodes.items() if node["Resources"].get("CPU")}
        if working and working <= self._foreign:
            raise NoNodeError(self.trouble())

    def _exclude(self, node: str) -> None:
        if node not in self._foreign:
            self._foreign.add(node)
            log.error("%s", self.trouble())

    def trouble(self) -> str:
        """Return what is wrong with the cluster; empty where nothing is."""
        now = time.monotonic()
        nodes = cluster.nodes()
        found = [
            f"node {nodes[name]['NodeManagerHostname']} ({nodes[name]['NodeManagerAddress']}) has other builds than "
            "this dispatcher and gets no tasks: install the same packages there, and start its Ray again"
            for name in sorted(self._foreign & nodes.keys())
        ]
        waiting = [one for one in self if one.started_at is None]
        late = [one for one in waiting if now > one.given_at + self._settings.start_seconds]
        if late and sum(one.started_at is not None for one in self) < max(self.cpus, 1):
            seconds, (stage, *_) = now - late[0].given_at, [one.stage for one in late]
            gpus = self._settings.render_gpus if self._settings.render_device != CPU and stage is Stage.render else 0
            found.append(
                f"a {stage} call has waited {seconds:.0f} s for Ray to start it: it needs 1 CPU, {gpus:g} GPUs and "
                f"{memory_bytes(stage, late[0].parts) / 2**30:.1f} GiB, and the interpreter {self._python(stage)} on "
                "every node; see raylet.out and runtime_env*.log among the logs of Ray on its nodes"
            )
        return "; ".join(found)

    def _python(self, stage: Stage) -> str:
        return str(self._settings.blender_python) if stage is Stage.render else "of the node"
