"""Machines on a network of their own: one is killed, the cable of one is pulled, one comes late.

    pytest -m slow tests/test_network.py -s

Each has a worker with a Ray of its own, or they are a Ray cluster as the Helm chart makes it. See
`machines`.
"""

import os
import re
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import stickslip_workers
import yaml
from harness import wait_for
from machines import BUCKET, URL, Lab, Machine, dispatch

CHART = Path(__file__).parents[1] / "deploy" / "helm" / "stickslip"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(2400), pytest.mark.xdist_group("network")]


def test_work_goes_on_whatever_happens_to_machines(
    hub: int, lab: Lab, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(message: str, seconds: float) -> None:
        with capsys.disabled():
            print(f"    {message:55} {seconds:5.1f} s, load {os.getloadavg()[0]:.1f}", flush=True)

    def lost(name: str, how: str) -> None:
        """Expect that the loss of a machine is noticed, and that others do its work."""
        held = lab.held(name)
        running = [seq for seq, state in held.items() if state == "running"]
        say(
            f"{how}: its {len(held)} tasks are free",
            lab.wait(f"the loss of {name}", lambda: not lab.held(name)),
        )
        say(f"{how}: what ran on it is done", lab.wait("its tasks", lambda: lab.left(running) == 0))

    with ExitStack() as stack:
        first, other, late = (
            Machine(name, number, hub, stack) for number, name in enumerate("abc", 11)
        )
        for machine in (first, other):
            machine.start(dispatch(machine.name, tmp_path), tmp_path / f"{machine.name}.log")
        lab.wait("work of both", lambda: all(lab.done(name) > 3 for name in "ab"))

        lab.wait("a task that runs", lambda: "running" in lab.held("a").values())
        first.kill()
        lost("a", "killed")

        late.start(dispatch("c", tmp_path), tmp_path / "c.log")
        say(
            "late: its first task is done",
            lab.wait("work of the late one", lambda: lab.done("c") > 0),
        )

        lab.wait("a task that runs", lambda: "running" in lab.held("b").values())
        other.plug("down")
        lost("b", "cable pulled")
        before = lab.done("b")
        other.plug("up")
        say(
            "cable plugged in: its next task is done",
            lab.wait("its return", lambda: lab.done("b") > before),
        )

        states = lab.finished()
    assert states == ["succeeded"] * len(states)
    tries, losses = lab.sums()
    assert tries == 0
    assert losses >= 2  # of running tasks; one at least on each machine that was lost
    assert lab.faults() == []


def ray_options(group: dict[str, Any]) -> list[str]:
    """Return the options that KubeRay makes of a group's parameters."""
    return [
        f"--{name}={value}" if value != "true" else f"--{name}"
        for name, value in group["rayStartParams"].items()
    ]


def test_nodes_of_the_charts_ray_cluster_come_and_go(
    hub: int,
    lab: Lab,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What KubeRay would start: a head, two nodes that work, and the dispatcher, which joins them.

    Then a node comes late, one has other builds, one is killed, one freezes, one is cut off, and
    the head is killed.
    """
    helm = pytest.importorskip("helm_python", reason="Helm is not installed: make setup-dev")
    values = {"store": {"url": BUCKET}, "ray": {"enabled": True, "maxReplicas": 2, "slots": 1}}
    with helm.Chart.load(CHART) as chart:
        text = chart.render(values, name="demo", namespace="lab")["stickslip/templates/ray.yaml"]
    cluster, dispatcher = (item for item in yaml.safe_load_all(text) if item is not None)
    ray = str(Path(sys.executable).with_name("ray"))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.delenv(
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", raising=False
    )  # other tests want loopback: no pod does
    monkeypatch.setenv("RAY_AUTH_MODE", cluster["spec"]["authOptions"]["mode"])
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    monkeypatch.setenv(
        "RAY_worker_niceness", "0"
    )  # 15 by default: other tests beside would starve the nodes
    container = dispatcher["spec"]["template"]["spec"]["containers"][0]
    script = re.sub(r"--url=\S+", f"--url={URL}", container["args"][0])
    script = script.replace("/etc/stickslip/worker-key", str(tmp_path / "worker-key"))
    package = Path(stickslip_workers.__file__).parent
    shutil.copytree(package, tmp_path / "other" / package.name)
    with (tmp_path / "other" / package.name / "stages" / "pack.py").open("a") as file:
        file.write("# another build\n")
    (group,) = cluster["spec"]["workerGroupSpecs"]
    pod = cluster["spec"]["headGroupSpec"]["template"]["spec"]["containers"][0]

    with ExitStack() as stack:
        names = ("head", "w1", "w2", "driver", "late", "foreign")
        machines = {
            name: Machine(name, number, hub, stack) for number, name in enumerate(names, 31)
        }
        address = f"{machines['head'].address}:6379"
        monkeypatch.setenv("RAY_ADDRESS", address)

        def start(name: str) -> None:
            here = f"--node-ip-address={machines[name].address}"
            command = [ray, "start", "--block", here, f"--address={address}", *ray_options(group)]
            if name == "head":
                command = [
                    "env",
                    *(f"{item['name']}={item['value']}" for item in pod["env"]),
                    ray,
                    "start",
                    "--block",
                ]
                command += [
                    here,
                    "--head",
                    "--port=6379",
                    *ray_options(cluster["spec"]["headGroupSpec"]),
                ]
            elif name == "driver":
                command = [*container["command"], script.replace("ray start", f"ray start {here}")]
            elif name == "foreign":
                command = ["env", f"PYTHONPATH={tmp_path / 'other'}", *command]
            machines[name].start(command, tmp_path / f"{name}.log", is_pod=True)

        def expect(condition: str, is_so: Callable[[], bool], limit: float) -> None:
            """Wait; the limit [s] is that of a quiet machine."""
            seconds = lab.wait(condition, is_so, limit)
            with capsys.disabled():
                print(
                    f"    {condition:65} {seconds:5.1f} s, load {os.getloadavg()[0]:.1f}",
                    flush=True,
                )

        def remove_node(name: str, how: Callable[[], None], condition: str, limit: float) -> None:
            """Lose a node that is at work, and expect that all that the dispatcher had then is
            done.
            """
            lab.wait(f"a task on {name}", machines[name].is_at_work)
            held = lab.held("demo-ray")
            assert held
            how()
            expect(f"{condition}: all tasks are done elsewhere", lambda: lab.left(held) == 0, limit)

        for name in ("head", "w1", "w2", "driver"):
            start(name)
        lab.wait("work of the cluster", lambda: lab.done("demo-ray") > 20, 400)
        start("late")
        expect("a node comes late: its first task runs", machines["late"].is_at_work, 15)
        start("foreign")
        refusal = "node foreign (10.213.0.36) has other builds"
        expect(
            "a node has other builds: it is named",
            lambda: refusal in lab.worker("demo-ray")["condition"]["reason"],
            40,
        )
        remove_node("w1", machines["w1"].kill, "a node is killed", 15)
        remove_node("w2", machines["w2"].freeze, "a node freezes", 40)
        machines["w2"].kill()
        start("w1")
        lab.wait("work of a node that is back", machines["w1"].is_at_work)
        remove_node(
            "late", lambda: machines["late"].plug("down"), "the network of a node is cut", 40
        )
        machines["late"].plug("up")
        assert not machines["foreign"].is_at_work()

        before = lab.worker("demo-ray")["id"]

        def is_replaced() -> bool:
            now = lab.worker("demo-ray")
            return bool(now.get("id", before) != before and now["condition"]["state"] == "ready")

        machines["head"].kill()
        start("head")
        expect("the head is killed: another driver is ready", is_replaced, 60)
        done = lab.done("demo-ray")
        lab.wait("more work", lambda: lab.done("demo-ray") > done + 20)
        states = lab.finished()
    assert states == ["succeeded"] * len(states)
    assert lab.sums()[0] == 0
    assert lab.faults() == []


PROVIDER = """
from ray.autoscaler._private.fake_multi_node.node_provider import FakeMultiNodeProvider

class Provider(FakeMultiNodeProvider):
    # Ray takes no `memory` among the resources of a node that it starts: it finds out how much
    # the node has.
    def _create_node_with_resources_and_labels(self, node_config, tags, count, resources, labels):
        resources = {name: value for name, value in resources.items() if name != "memory"}
        super()._create_node_with_resources_and_labels(node_config, tags, count, resources, labels)
"""
AUTOSCALING = """
cluster_name: fake
max_workers: 2
idle_timeout_minutes: 0.1
setup_commands: []
head_setup_commands: []
worker_setup_commands: []
initialization_commands: []
head_start_ray_commands: []
worker_start_ray_commands: []
file_mounts: {{}}
cluster_synced_files: []
file_mounts_sync_continuously: false
auth: {{}}
upscaling_speed: 1.0
provider:
  type: external
  module: fake_nodes.Provider
  gcs_address: {address}
  head_node_id: {head}
  launch_multiple: true
head_node_type: ray.head.default
available_node_types:
  ray.head.default: {{resources: {{CPU: 0}}, node_config: {{}}, max_workers: 0}}
  worker:
    resources: {{CPU: 1, memory: 4294967296, object_store_memory: 134217728}}
    node_config: {{}}
    min_workers: 0
    max_workers: 2
"""

# In a process of its own: the client of a head that is gone ends the process a minute later.
NODES = """
import sys
from ray._raylet import GcsClient
nodes = GcsClient(address=sys.argv[1]).get_all_node_info()  # what `ray status` asks
print(sum(node.state == 0 for node in nodes.values()))
"""


def test_an_autoscaler_adds_nodes_for_a_job_and_removes_them(
    hub: int,
    lab: Lab,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ray's autoscaler, version 2, with nodes that are processes of one machine, and without a
    token.
    """
    head = "f" * 51 + "0" * 5
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", raising=False)
    for name, value in {
        "RAY_AUTH_MODE": "disabled",
        "RAY_FAKE_CLUSTER": "1",
        "RAY_enable_autoscaler_v2": "1",
        "RAY_CLOUD_INSTANCE_ID": head,
        "RAY_OVERRIDE_NODE_ID_FOR_TESTING": head,
        "AUTOSCALER_UPDATE_INTERVAL_S": "1",
    }.items():
        monkeypatch.setenv(name, value)
    with ExitStack() as stack:
        machine = Machine("head", 41, hub, stack)
        address = f"{machine.address}:6379"
        (tmp_path / "fake_nodes.py").write_text(PROVIDER)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        config = tmp_path / "autoscaling.yaml"
        config.write_text(AUTOSCALING.format(address=address, head=head))
        ray = (
            f"ray start --head --node-ip-address={machine.address} --port=6379 --num-cpus=0 "
            "--include-dashboard=false"
        )
        ray += (
            f" --object-store-memory=134217728 --disable-usage-stats --autoscaling-config={config}"
        )
        words = [*dispatch("scaled", tmp_path), "--ray-address", address]
        words = [word for word in words if word not in ("--max-cpus", "1")]
        machine.start(["sh", "-c", f'{ray} && exec "$@"', "sh", *words], tmp_path / "head.log")

        wait_for(
            "the dispatcher",
            lambda: lab.worker("scaled").get("condition", {}).get("state") == "ready" or None,
            240,
        )

        def nodes() -> int:
            """Return how many nodes there are beside the head."""
            return int(subprocess.check_output([sys.executable, "-c", NODES, address])) - 1

        assert nodes() == 0
        begin = time.monotonic()
        lab.keep_busy()
        wait_for("two nodes", lambda: True if nodes() == 2 else None, 240)
        up = time.monotonic() - begin
        states = lab.finished()
        begin = time.monotonic()
        wait_for("no nodes", lambda: True if nodes() == 0 else None, 120)
        with capsys.disabled():
            down, load = time.monotonic() - begin, os.getloadavg()[0]
            print(
                f"    0 -> 2 nodes after {up:.1f} s, 2 -> 0 {down:.1f} s after the job, load "
                f"{load:.1f}",
                flush=True,
            )
    assert states == ["succeeded"]
    assert lab.faults() == []
