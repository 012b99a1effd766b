"""A real Slurm with two nodes runs `deploy/slurm/stickslip.sbatch`.

What it takes back is queued again and goes on.

    pytest -m slow tests/test_slurm.py -s

The nodes are machines of a network of their own, see `machines`. It needs slurmctld, slurmd,
slurm-client and munge.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest
from harness import wait_for
from machines import BUCKET, HUB, URL, Lab, Machine, dies_with_us

SBATCH = Path(__file__).parents[1] / "deploy" / "slurm" / "stickslip.sbatch"
NODES = ("n1", "n2")

# A job that was queued again waits until no node can still trust it, two minutes unless
# `cred_expire` says otherwise.
CONFIG = """
ClusterName=test
SlurmctldHost=hub({hub})
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={place}/munge.socket,cred_expire=5
CredType=cred/munge
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool-%n
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd-%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MailProg=/bin/true
ReturnToService=2
SlurmctldTimeout=30
SlurmdTimeout=30
KillWait=30
{nodes}
PartitionName=all Nodes={names} Default=YES MaxTime=INFINITE State=UP
"""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


class Slurm:
    """A cluster with one job."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self.job = ""

    def __call__(self, *words: str) -> str:
        done = subprocess.run(words, capture_output=True, text=True, cwd=self._place)
        assert done.returncode == 0, (words, done.stdout, done.stderr)
        return done.stdout.strip()

    def submit(self, *options: str) -> None:
        self.job = self("sbatch", "--parsable", *options, str(SBATCH))

    def states(self) -> dict[str, tuple[str, int]]:
        """Return the state of each task of the array, and how often it was queued again."""
        states_of_jobs = {}
        for line in self("scontrol", "--oneliner", "show", "job", self.job).splitlines():
            words = dict(word.partition("=")[::2] for word in line.split() if "=" in word)
            states_of_jobs[words["ArrayTaskId"]] = (words["JobState"], int(words["Restarts"]))
        return states_of_jobs

    def node_of(self, task: str) -> str:
        return self("squeue", "--noheader", "--jobs", f"{self.job}_{task}", "--format", "%N")


@pytest.fixture
def slurm(hub: int, lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Slurm]:
    programs = {name: shutil.which(name) for name in ("munged", "slurmctld", "slurmd", "sbatch")}
    missing = [name for name, path in programs.items() if path is None]
    if missing:
        pytest.skip(
            f"{', '.join(missing)} not installed: apt-get install slurmctld slurmd slurm-client "
            "munge"
        )
    shared = tmp_path / "shared"
    shared.mkdir()
    (tmp_path / "state").mkdir()
    key = tmp_path / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o600)
    lines = [
        f"NodeName={name} NodeAddr=10.213.0.{number} CPUs=1"
        for number, name in enumerate(NODES, 21)
    ]
    config = tmp_path / "slurm.conf"
    config.write_text(
        CONFIG.format(hub=HUB, place=tmp_path, nodes="\n".join(lines), names=",".join(NODES))
    )
    # The directory that all nodes see: the installation, and the key.
    prefix = Path(sys.prefix)
    (shared / ".venv").symlink_to(prefix)
    blender = os.environ.get("STICKSLIP_BLENDER_PYTHON")
    (shared / ".venv-blender").symlink_to(
        Path(blender).parents[1] if blender else prefix.parent / ".venv-blender"
    )
    shutil.copy(tmp_path / "worker-key", shared)
    for name, value in {
        "SLURM_CONF": str(config),
        "STICKSLIP_URL": URL,
        "STICKSLIP_SHARED": str(shared),
        "STICKSLIP_STORE": BUCKET,
    }.items():
        monkeypatch.setenv(name, value)

    munge = [
        "munged",
        "--foreground",
        "--force",
        f"--key-file={key}",
        f"--socket={tmp_path}/munge.socket",
    ]
    munge += [
        f"--pid-file={tmp_path}/munge.pid",
        f"--seed-file={tmp_path}/munge.seed",
        "--log-file=/dev/null",
    ]
    controller = ["unshare", "--uts", "sh", "-c", "hostname hub && exec slurmctld -D"]
    with ExitStack() as stack:
        for name, command in (("munged", munge), ("slurmctld", controller)):
            log = stack.enter_context((tmp_path / f"{name}.log").open("wb"))
            process = subprocess.Popen(command, stdout=log, stderr=log, preexec_fn=dies_with_us)
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)
            if name == "munged":
                wait_for("munge", lambda: (tmp_path / "munge.socket").exists() or None, 10)
        for number, name in enumerate(NODES, 21):
            machine = Machine(name, number, hub, stack)
            machine.start(["slurmd", "-D"], tmp_path / f"{name}.log")
        cluster = Slurm(tmp_path)

        def all_idle() -> bool | None:
            done = subprocess.run(
                ["sinfo", "--noheader", "--Node", "--format=%T"], capture_output=True, text=True
            )
            return True if done.stdout.split() == ["idle"] * len(NODES) else None

        wait_for("the nodes", all_idle, 60)
        yield cluster
        if cluster.job:
            cluster("scancel", cluster.job)
            wait_for(
                "an empty queue", lambda: True if not cluster("squeue", "--noheader") else None, 60
            )


def test_an_array_goes_on_where_slurm_takes_its_nodes(
    lab: Lab, slurm: Slurm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(message: str, seconds: float) -> None:
        with capsys.disabled():
            print(f"    {message:60} {seconds:5.1f} s, load {os.getloadavg()[0]:.1f}", flush=True)

    def worker(task: str) -> str:
        """Return the name of the worker of a task of the array: each has a job id of its own."""
        line = slurm("scontrol", "--oneliner", "show", "job", f"{slurm.job}_{task}")
        return "slurm-" + line.split("JobId=")[1].split()[0]

    def done(task: str) -> int:
        return lab.done(worker(task))

    def state(task: str, expected: str, restarts: int) -> bool:
        return slurm.states()[task] == (expected, restarts)

    slurm.submit("--array=1-2", "--time=30")
    say(
        "submitted: both nodes have done tasks",
        lab.wait("both", lambda: all(done(task) > 3 for task in "12")),
    )
    assert {slurm.node_of(task) for task in "12"} == set(NODES)

    # What Slurm does a minute before the end of the time.
    slurm("scancel", "--batch", "--signal=TERM", f"{slurm.job}_1")
    name = worker("1")
    say(
        "TERM: its tasks are free",
        lab.wait("tasks that are given back", lambda: not lab.held(name)),
    )
    say(
        "TERM: it waits in the queue again",
        lab.wait("the queue", lambda: slurm.states()["1"][1] == 1),
    )
    # What an administrator does, or a job of higher priority: Slurm ends all processes of the job,
    # Ray's, too.
    slurm("scontrol", "requeue", f"{slurm.job}_2")
    for task in "12":
        say(f"task {task} runs again", lab.wait("its turn", partial(state, task, "RUNNING", 1)))
    before = {task: done(task) for task in "12"}
    say(
        "both have done more",
        lab.wait("more", lambda: all(done(task) > before[task] for task in "12")),
    )

    ended = lab.finished()
    assert ended == ["succeeded"] * len(ended)
    assert lab.sums()[0] == 0  # no try was charged
    assert lab.faults() == []
    slurm("scancel", slurm.job)
    gone = ["CANCELLED"] * len(NODES)
    wait_for("the end", lambda: [state for state, _ in slurm.states().values()] == gone or None, 90)
    text = "".join(path.read_text() for path in tmp_path.glob("stickslip-*.log"))
    assert (
        text.count("registered as worker-") == 4
    )  # each worker twice, and nothing came back after that
