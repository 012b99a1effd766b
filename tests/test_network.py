"""Machines on a network of their own: one is killed, the cable of one is pulled, one comes late.

    pytest -m slow tests/test_network.py -s

Each has a worker with a Ray of its own. See `machines`.
"""

import os
from contextlib import ExitStack
from pathlib import Path

import pytest
from machines import Lab, Machine, dispatch

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
    assert losses >= 2  # of those that ran; one at least on each machine that was lost
    assert lab.faults() == []
