"""The speed of a machine is measured once, and again when its CPUs change."""

import json
import logging
import subprocess
import time
from pathlib import Path

import pytest
from stickslip_schemas.plan.costs import MachineSpeed
from stickslip_workers import machine


@pytest.fixture
def other_share(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Replace the meter; its only element is the share of the CPUs that other programs use."""
    share = [0.0]

    class Meter:
        seconds = 10.0

        @property
        def other_share(self) -> float:
            return share[0]

    monkeypatch.setattr(machine, "CpuMeter", Meter)
    return share


@pytest.fixture
def measurements(monkeypatch: pytest.MonkeyPatch, other_share: list[float]) -> list[int]:
    """Replace the drag; collect the number of processes of each measurement."""
    calls: list[int] = []

    def measure_speed(processes: int) -> MachineSpeed:
        calls.append(processes)
        return MachineSpeed(cpu_speed=0.5 / (1.0 + other_share[0]), cpu_available=0.25)

    monkeypatch.setattr(machine, "measure_speed", measure_speed)
    return calls


def test_a_measured_speed_is_stored(tmp_path: Path, measurements: list[int]) -> None:
    file = tmp_path / "cache" / "speed.json"
    first = machine.SpeedGauge(file, slots=16)
    assert first.speed == MachineSpeed(cpu_speed=0.5, cpu_available=0.25)
    assert first.is_settled
    assert machine.SpeedGauge(file, slots=16).speed == first.speed
    assert measurements == [machine.MAX_PROCESSES]


def test_a_disturbed_speed_is_measured_again_once_the_cpus_are_quiet(
    tmp_path: Path, measurements: list[int], other_share: list[float]
) -> None:
    file = tmp_path / "speed.json"
    other_share[0] = 1.0
    gauge = machine.SpeedGauge(file, slots=2)
    assert gauge.speed.cpu_speed == 0.25
    assert not gauge.settle()
    # Another start takes the disturbed speed over, and waits for quiet CPUs as well.
    gauge = machine.SpeedGauge(file, slots=2)
    assert gauge.speed.cpu_speed == 0.25
    assert not gauge.is_settled
    assert len(measurements) == 1
    other_share[0] = 0.5 * machine.QUIET_SHARE
    assert gauge.settle()
    assert gauge.speed.cpu_speed == pytest.approx(0.5, rel=0.06)
    assert not gauge.settle()
    assert machine.SpeedGauge(file, slots=2).is_settled
    assert len(measurements) == 2


def test_others_on_the_cpus_are_seen() -> None:
    """A program that is not a child that has ended takes a CPU."""
    busy = subprocess.Popen([machine.sys.executable, "-c", "while True: pass"])
    try:
        meter = machine.CpuMeter()
        time.sleep(1.0)
        assert meter.seconds >= 1.0
        # The child has a CPU, or a good part of one if many programs run.
        assert meter.other_share > 0.3 / (machine.os.cpu_count() or 1)
    finally:
        busy.kill()
        busy.wait()


def test_other_cpus_are_measured_again(
    tmp_path: Path, measurements: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "speed.json"
    machine.SpeedGauge(file, slots=1)
    monkeypatch.setattr(machine, "machine_name", lambda: "another CPU")
    machine.SpeedGauge(file, slots=1)
    assert measurements == [1, 1]


@pytest.mark.parametrize("content", [b"", b"{}", b'{"machine": 3}'])
def test_a_damaged_file_is_measured_again_with_a_warning(
    tmp_path: Path, measurements: list[int], content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "speed.json"
    file.write_bytes(content)
    machine.SpeedGauge(file, slots=1)
    assert measurements == [1]
    assert "is not the speed of a machine" in caplog.text


def test_a_machine_that_cannot_be_measured_is_the_reference_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def measure_speed(_processes: int) -> MachineSpeed:
        raise subprocess.CalledProcessError(1, ["python"])

    monkeypatch.setattr(machine, "measure_speed", measure_speed)
    with caplog.at_level(logging.WARNING):
        assert machine.SpeedGauge(tmp_path / "speed.json", slots=2).speed == MachineSpeed()
    assert "the speed of this machine is unknown" in caplog.text
    assert not (tmp_path / "speed.json").exists()


def test_a_drag_alone_and_drags_together_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under a quota of one CPU, the drag has it alone, and two share it."""
    runs: list[int] = []

    def time_drags(processes: int) -> list[machine.DragTimes]:
        runs.append(processes)
        wall = 0.25 * processes
        return [machine.DragTimes(cpu_seconds=0.25, wall_seconds=wall)] * processes

    monkeypatch.setattr(machine, "_time_drags", time_drags)
    speed = machine.measure_speed(2)
    assert (speed.cpu_alone, speed.cpu_available) == (1.0, 0.5)
    assert speed.cpu_speed == pytest.approx(machine.REFERENCE_CPU_SECONDS / 0.25)
    assert runs == [1, 2]
    # With one slot, both are the same.
    assert machine.measure_speed(1).cpu_available == 1.0
    assert runs == [1, 2, 1]


def test_the_name_of_a_machine_has_its_quota(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    monkeypatch.setattr(machine, "_control_groups", lambda: iter([tmp_path]))
    assert machine.machine_name().endswith("quota 50000 100000")
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert machine.machine_name().endswith("quota max")


@pytest.mark.physics
def test_the_drag_takes_a_second_of_cpu_at_most() -> None:
    command = [machine.sys.executable, "-m", "stickslip_workers.machine"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    times = json.loads(done.stdout)
    assert 0 < times["cpu_seconds"] <= times["wall_seconds"] * 1.05
