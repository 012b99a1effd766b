"""Processes of `stickslip up` that die: who is started again, and what the terminal says."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stickslip_services.errors import CommandError
from stickslip_services.local import child
from stickslip_services.local.child import MAX_FAILED_STARTS, Child
from stickslip_services.local.supervisor import FAILED_START_SECONDS
from stickslip_testing.servers import wait_until

FAIL = "import sys; print('starting'); sys.exit('no route to the raylet')"


def process(tmp_path: Path, program: str, *, name: str = "ray", for_ever: bool = False) -> Child:
    return Child(
        name,
        [sys.executable, "-S", "-c", program],
        tmp_path / f"{name}.log",
        start_seconds=FAILED_START_SECONDS[name],
        stop_seconds=1.0,
        never_gives_up=for_ever,
    )


def run_until_dead(running: Child) -> None:
    """Start a child, and notice that it has ended."""
    if running.process is None:
        running.restart_if_dead()
    wait_until(running.has_ended, seconds=20)
    running.restart_if_dead()


@pytest.fixture(autouse=True)
def _no_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "FIRST_WAIT_SECONDS", 0.0)


def test_a_ray_that_does_not_start_says_why_and_gives_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ray = process(tmp_path, FAIL)
    for _ in range(MAX_FAILED_STARTS - 1):
        run_until_dead(ray)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == MAX_FAILED_STARTS - 1
    for line in lines:
        assert "the ray exited with status 1 (no route to the raylet); starting it again" in line
    with pytest.raises(CommandError, match="for the 5th time within 60 s of its start") as error:
        run_until_dead(ray)
    assert "  no route to the raylet" in str(error.value)


def test_ray_that_dies_after_half_a_minute_has_failed_to_start(tmp_path: Path) -> None:
    """It waits so long for its own processes, and was restarted forever."""
    ray = process(tmp_path, FAIL)
    for _ in range(MAX_FAILED_STARTS):
        ray.restart_if_dead()
        ray.started_at -= 30.0
        wait_until(ray.has_ended, seconds=20)
        if ray.failed_starts < MAX_FAILED_STARTS - 1:
            ray.restart_if_dead()
    with pytest.raises(CommandError, match="5th time"):
        ray.restart_if_dead()


def test_a_coordinator_that_keeps_dying_ends_nobody(tmp_path: Path) -> None:
    """Simulations that are running need none for a while."""
    coordinator = process(tmp_path, FAIL, name="coordinator", for_ever=True)
    for _ in range(3 * MAX_FAILED_STARTS):
        run_until_dead(coordinator)
    assert coordinator.failed_starts == 3 * MAX_FAILED_STARTS


def test_waits_grow_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "FIRST_WAIT_SECONDS", 0.5)
    coordinator = process(tmp_path, FAIL, name="coordinator", for_ever=True)
    waits = []
    for _ in range(8):
        coordinator.start_again_at = 0.0
        run_until_dead(coordinator)
        waits.append(round(coordinator.start_again_at - time.monotonic(), 1))
    assert waits == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]


def test_a_child_that_has_run_for_long_starts_again_at_once(tmp_path: Path) -> None:
    dispatcher = process(tmp_path, FAIL, name="dispatcher")
    for _ in range(3 * MAX_FAILED_STARTS):
        dispatcher.restart_if_dead()
        dispatcher.started_at -= FAILED_START_SECONDS["dispatcher"]
        wait_until(dispatcher.has_ended, seconds=20)
        dispatcher.restart_if_dead()
    assert dispatcher.failed_starts == 0


@pytest.mark.real
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, -15)])
def test_a_signal_ends_a_coordinator_without_a_traceback(
    tmp_path: Path, number: int, status: int
) -> None:
    command = [sys.executable, "-m", "stickslip_services.app", "--data", str(tmp_path / "data")]
    server = subprocess.Popen(
        [*command, "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    assert server.stdout.readline().startswith("listening on ")
    os.kill(server.pid, number)
    _, log = server.communicate(timeout=30)
    assert "Traceback" not in log
    assert server.returncode == status
