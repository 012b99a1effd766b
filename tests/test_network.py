"""Machines on a network of their own: one is killed, the cable of one is pulled, one comes late.

    pytest -m slow tests/test_network.py -s

Each has a worker with a Ray of its own, or they are a Ray cluster as the Helm chart makes it. See `machines`.
"""

import os
import re
import secrets
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
from machines import BUCKET, URL, Lab, Machine, dispatch

CHART = Path(__file__).parents[1] / "deploy" / "helm" / "stickslip"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def test_work_goes_on_whatever_happens_to_machines(
    hub: int, lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(what: str, seconds: float) -> None:
        with capsys.disabled():
            print(f"    {what:55} {seconds:5.1f} s, load {os.getloadavg()[0]:.1f}", flush=True)

    def lost(name: str, how: str) -> None:
        """Expect that the coordinator notices the loss of a machine, and that others do its work."""
        held = lab.held(name)
        ran = [seq for seq, state in held.items() if state == "running"]
        say(f"{how}: its {len(held)} tasks are free", lab.wait(f"the loss of {name}", lambda: not lab.held(name)))
        say(f"{how}: what ran on it is done", lab.wait("its tasks", lambda: lab.left(ran) == 0))

    with ExitStack() as stack:
        one, other, late = (Machine(name, number, hub, stack) for number, name in enumerate("abc", 11))
        for machine in (one, other):
            machine.start(dispatch(machine.name, tmp_path), tmp_path / f"{machine.name}.log")
        lab.wait("work of both", lambda: all(lab.done(name) > 3 for name in "ab"))

        lab.wait("a task that runs", lambda: "running" in lab.held("a").values())
        one.kill()
        lost("a", "killed")

        late.start(dispatch("c", tmp_path), tmp_path / "c.log")
        say("late: its first task is done", lab.wait("work of the late one", lambda: lab.done("c") > 0))

        lab.wait("a task that runs", lambda: "running" in lab.held("b").values())
        other.plug("down")
        lost("b", "cable pulled")
        before = lab.done("b")
        other.plug("up")
        say("cable plugged in: its next task is done", lab.wait("its return", lambda: lab.done("b") > before))

        states = lab.finished()
    assert states == ["succeeded"] * len(states)
    tries, losses = lab.sums()
    assert tries == 0
    assert losses >= 2  # of running tasks; one at least on each machine that was lost
    assert lab.faults() == []


def ray_options(group: dict[str, Any]) -> list[str]:
    """Return the options that KubeRay makes of a group's parameters."""
    return [f"--{name}={value}" if value != "true" else f"--{name}" for name, value in group["rayStartParams"].items()]


def test_the_ray_cluster_of_the_chart_works(
    hub: int, lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What KubeRay would start: a head, two nodes that work, and the dispatcher, which joins them."""
    helm = pytest.importorskip("helm_python", reason="Helm is not installed: pip install helm-python-sdk")
    values = {"store": {"url": BUCKET}, "ray": {"enabled": True, "maxReplicas": 2, "slots": 1}}
    with helm.Chart.load(CHART) as chart:
        text = chart.render(values, name="demo", namespace="lab")["stickslip/templates/ray.yaml"]
    cluster, dispatcher = (item for item in yaml.safe_load_all(text) if item is not None)
    ray = str(Path(sys.executable).with_name("ray"))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", raising=False)  # other tests want loopback: no pod does
    monkeypatch.setenv("RAY_AUTH_MODE", cluster["spec"]["authOptions"]["mode"])
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    container = dispatcher["spec"]["template"]["spec"]["containers"][0]
    script = re.sub(r"--url=\S+", f"--url={URL}", container["args"][0])
    script = script.replace("/etc/stickslip/worker-key", str(tmp_path / "worker-key"))
    with ExitStack() as stack:
        names = ("head", "w1", "w2", "driver")
        machines = {name: Machine(name, number, hub, stack) for number, name in enumerate(names, 31)}
        address = f"{machines['head'].address}:6379"
        monkeypatch.setenv("RAY_ADDRESS", address)
        (group,) = cluster["spec"]["workerGroupSpecs"]
        for name, machine in machines.items():
            here = f"--node-ip-address={machine.address}"
            command = [ray, "start", "--block", here, f"--address={address}", *ray_options(group)]
            if name == "head":
                head = ray_options(cluster["spec"]["headGroupSpec"])
                pod = cluster["spec"]["headGroupSpec"]["template"]["spec"]["containers"][0]
                command = ["env", *(f"{item['name']}={item['value']}" for item in pod["env"]), ray, "start", "--block"]
                command += [here, "--head", "--port=6379", *head]
            elif name == "driver":
                command = [*container["command"], script.replace("ray start", f"ray start {here}")]
            machine.start(command, tmp_path / f"{name}.log", is_pod=True)
        lab.wait("work of the cluster", lambda: lab.done("demo-ray") > 20, 400)
        # What `ray status` asks; this process is no node of the cluster.
        from ray._raylet import GcsClient  # type: ignore[attr-defined]

        nodes = GcsClient(address=address).get_all_node_info
        machines["w1"].kill()
        seconds = lab.wait("the loss of a node", lambda: sum(node.state == 0 for node in nodes().values()) == 3)
        with capsys.disabled():
            print(f"    a node is killed: Ray knows it after {seconds:.1f} s, load {os.getloadavg()[0]:.1f}")
        before = lab.done("demo-ray")
        lab.wait("work of the rest", lambda: lab.done("demo-ray") > before + 20)
        states = lab.finished()
    assert states == ["succeeded"] * len(states)
    assert lab.sums()[0] == 0
    assert lab.faults() == []
