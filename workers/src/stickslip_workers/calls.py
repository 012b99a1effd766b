"""Calls: the tasks of Ray that this dispatcher has given to a cluster."""

import math
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

from stickslip_schemas.base import Stage

from stickslip_workers import call
from stickslip_workers.batches import Call
from stickslip_workers.settings import CPU, RENDER_DEVICE, Settings

LOOK_SECONDS = 2.0
"""Time between two looks at the nodes of the cluster [s], which cost 3 ms each."""

DEMAND = 1.5
"""Calls given to Ray for each CPU. An autoscaler adds nodes for those that wait."""

WARM_UP_SECONDS = 10.0
"""The first tasks wait so long for processes to start [s], or they would start more."""

CALLS_PER_PROCESS = 1000
"""Calls after which a process gives way to a fresh one: Blender's memory grows slowly."""


class StartError(RuntimeError):
    """This dispatcher cannot do anything on this cluster."""


class NotDoneError(RuntimeError):
    """Nothing of a call was done, and it must be given again."""


class Calls:
    """The calls of a driver of Ray, which must be connected; `described` by the stages and (True) by the renderer."""

    def __init__(self, settings: Settings, described: Mapping[bool, Mapping[str, Any]]) -> None:
        import ray

        self._settings = settings
        self._described = described
        self._calls: dict[Any, Call] = {}
        self._foreign: set[str] = set()
        self._lost: set[str] = set()
        """Nodes that were lost last. Later calls avoid them by name: of equal ones, Ray asks a frozen node forever."""
        self._warm: set[str] = set()
        """Nodes on which processes were started."""
        self._next_look = 0.0
        self.cpus = 0.0
        """CPUs that calls may use, of the nodes that are there now."""
        self.trouble = ""
        """What is wrong with the cluster; empty where nothing is."""
        ray.cloudpickle.register_pickle_by_value(call)
        common = {"max_retries": 0, "num_returns": "streaming", "max_calls": CALLS_PER_PROCESS}
        variables = {"env_vars": {"OMP_NUM_THREADS": "1", RENDER_DEVICE: settings.render_device}}
        python = {"py_executable": str(settings.blender_python)}
        self._gpus = 0 if settings.render_device == CPU else settings.render_gpus
        self._remote: dict[bool, Any] = {
            False: ray.remote(**common, runtime_env=variables)(call.run),
            True: ray.remote(**common, num_gpus=self._gpus, runtime_env=variables | python)(call.run),
        }
        list(self._look())
        ray.wait(list(self._calls), num_returns=len(self._calls), timeout=WARM_UP_SECONDS)

    def __iter__(self) -> Iterator[Call]:
        return iter(list(self._calls.values()))

    def room(self) -> int:
        """Return how many more calls to give to Ray."""
        most = self._settings.max_cpus or max(math.ceil(DEMAND * self.cpus), 1)
        return most - sum(bool(one.parts) and not one.is_express for one in self)

    def is_clogged(self) -> bool:
        """Return whether all CPUs have been taken for long."""
        began = time.monotonic() - self._settings.clog_seconds
        return 0 < self.cpus <= sum(one.started_at < began and not one.is_express for one in self)

    def give(self, one: Call, node: str = "") -> None:
        """Give a call to Ray, which may choose the node."""
        renders, settings = one.stage is Stage.render, self._settings
        options: dict[str, Any] = {"num_cpus": 1 if one.parts and not one.is_express else 0, "memory": one.memory}
        if node or (avoided := sorted(self._foreign | self._lost)):
            options["label_selector"] = {"ray.io/node-id": node or f"!in({','.join(avoided)})"}
        one.given_at = time.monotonic()
        one.reference = (
            self._remote[renders]
            .options(name=one.stage.value if one.parts else "warm-up", **options)
            .remote(
                settings.render_actor if renders else "stickslip_workers.stages.run:StageActor",
                settings.store,
                self._described[renders]["builds"],
                "render" if renders else "run",
                one.arguments(),
                one.stage is Stage.simulate and len(one.leases) == 1,
            )
        )
        self._calls[one.reference] = one

    def collect(self, timeout: float) -> Iterator[tuple[Call, Any]]:
        """Wait for news; yield calls that have started with None, with frames done and in all, or at their end with
        the list of their answers or an exception.
        """
        import ray

        if time.monotonic() >= self._next_look:
            yield from self._look()
        if not self._calls:
            return time.sleep(timeout)
        ray.wait(list(self._calls), timeout=timeout)
        for reference in ray.wait(list(self._calls), num_returns=len(self._calls), timeout=0)[0]:
            one = self._calls[reference]
            try:
                said = ray.get(next(reference))
            except ray.exceptions.LocalRayletDiedError:  # no call of this driver can end well any more
                raise
            except ray.exceptions.RayError as error:
                said = error
            if isinstance(said, dict):
                one.started_at, one.node = time.monotonic(), said["node"]
                if said["foreign"]:
                    self._foreign.add(one.node)
                said = NotDoneError(f"node {one.node} is foreign") if said["foreign"] else None
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
        ray.cancel(one.reference, force=True)

    def _look(self) -> Iterator[tuple[Call, Any]]:
        """Look which nodes are alive: Ray may wait forever for a call on a lost one, also if it has not said where."""
        import ray

        nodes = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
        cpus = {name: int(node["Resources"].get("CPU", 0)) for name, node in nodes.items()}
        most = self._settings.max_cpus or sys.maxsize
        self.cpus = min(sum(count for name, count in cpus.items() if name not in self._foreign), most)
        self.trouble = "; ".join(self._troubles(nodes))
        if any(cpus.values()) and not self.cpus:
            raise StartError(self.trouble)
        self._next_look = time.monotonic() + LOOK_SECONDS
        lost = self._warm - nodes.keys()
        self._lost = lost or self._lost
        for name in nodes.keys() - self._warm:  # its first tasks should not have to wait for Blender
            for stage in (Stage.simulate, Stage.render) * min(cpus[name], most):
                self.give(Call(stage, []), name)
        self._warm = set(nodes)
        for one in self:
            if one.node and one.node not in nodes:
                del self._calls[one.reference]
                yield one, RuntimeError(f"node {one.node} is gone")
            elif lost and not one.node:
                self.cancel(one, "its node may be gone")
                del self._calls[one.reference]
                yield one, NotDoneError(f"it may be on node {min(lost)}, which is gone")

    def _troubles(self, nodes: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
        for node in (nodes[name] for name in sorted(self._foreign & nodes.keys())):
            yield (
                f"node {node['NodeManagerHostname']} ({node['NodeManagerAddress']}) has other builds than this "
                "dispatcher and gets no tasks: install the same packages there, and start its Ray again"
            )
        late = next((one for one in self if not one.node), None)  # the one that was given first
        waited = time.monotonic() - late.given_at if late else 0.0
        if late and waited > self._settings.start_seconds and sum(bool(one.node) for one in self) < max(self.cpus, 1):
            renders = late.stage is Stage.render
            gpus, python = (self._gpus, self._settings.blender_python) if renders else (0, "of the node")
            yield (
                f"a {late.stage} call has waited {waited:.0f} s for Ray to start it: it needs 1 CPU, {gpus:g} GPUs and "
                f"{late.memory / 2**30:.1f} GiB, and the interpreter {python} on every node; see raylet.out and "
                "runtime_env*.log among the logs of Ray on its nodes"
            )
