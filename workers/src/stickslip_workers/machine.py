"""The speed of this machine: a short drag of cloth, timed on some of its CPUs at the same time.

The packaged costs of specs are CPU seconds of a reference machine, on which `REFERENCE_CPU_SECONDS`
was measured. Three numbers convert them to another machine:

    cpu_speed     = REFERENCE_CPU_SECONDS / CPU seconds of the drag here
    cpu_available = CPU seconds of the drag here / its wall time
    cpu_alone     = the same, of a drag that runs alone

The last two are below 1 if a quota or other programs leave less than a CPU to a process. Under a
quota of one CPU, a process that runs alone has all of it, and each of two has half.

Other programs spoil a measurement: they take CPUs, and the drag itself needs more CPU time beside
them. A worker is often measured while Ray starts. Such a speed is stored as disturbed: workers use
it, and measure again when they are idle and the CPUs are quiet (`SpeedGauge`).

    python -m stickslip_workers.machine     runs the drag and prints its times as JSON
"""

import json
import logging
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError
from stickslip_schemas.base import Document, Float
from stickslip_schemas.plan.costs import MachineSpeed

log = logging.getLogger(__name__)

REFERENCE_CPU_SECONDS = 0.235
"""CPU time of the drag on the machine of the packaged costs [s].

The machine is one core of a virtual AMD EPYC with AVX-512, benchmarks/results/job-costs.json.
"""

DRAG_VERTICES = 11
DRAG_SECONDS = 10.0
"""Mesh and duration [s] of the drag.

It is long enough to time, and three drags take 1.5 s of CPU.
"""

MAX_PROCESSES = 2
"""Number of drags at the same time.

A quota shows with two, and the measurement stays below 2 CPU s.
"""

QUIET_SHARE = 0.1
"""Share of all CPUs that other programs may use during a measurement that is not disturbed.

While Ray and other programs used two CPUs of two, the drag took three times its CPU time.
"""

QUIET_SECONDS = 2.0
"""Time for which the CPUs are quiet before a speed is measured again [s]: twice a measurement."""

TIMEOUT_SECONDS = 60.0
"""Limit of the drag [s]. A slower machine is not measured."""


class StoredSpeed(Document):
    """A measured speed, and its machine."""

    machine: str
    speed: MachineSpeed
    is_disturbed: bool = False


class DragTimes(Document):
    """Times of the drag in one process [s]."""

    cpu_seconds: Float
    wall_seconds: Float


def machine_name() -> str:
    """Return a text that changes with the CPUs: their model, number and quota."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # the system is not Linux
        lines = []
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() == "model name":
            model = value.strip()
            break
    cpus = os.cpu_count() if sys.platform != "linux" else len(os.sched_getaffinity(0))
    return f"{model}, {cpus} CPUs, quota {_cpu_quota()}"


def _cpu_quota() -> str:
    """Return the CPU quotas of this process's control groups, or `max` without a quota."""
    quotas = []
    for folder in _control_groups():
        # Version 2 has a file with quota and period. Version 1 has a file with only the quota [us].
        for name, unlimited in (("cpu.max", "max"), ("cpu.cfs_quota_us", "-1")):
            try:
                text = (folder / name).read_text(encoding="ascii").strip()
            except OSError:
                continue
            if not text.startswith(unlimited):
                quotas.append(text)
    return "; ".join(quotas) or "max"


def _control_groups() -> Iterator[Path]:
    """Yield the folders of the control groups that may limit the CPU time of this process.

    A group's quota also holds for the groups below it. `/proc/self/cgroup` has a line
    `number:controllers:group` for each hierarchy. In version 2, the controllers are empty.
    """
    try:
        mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines()
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:  # the system is not Linux
        return
    groups = {}
    for line in lines:
        _, controllers, group = line.split(":", 2)
        for controller in controllers.split(","):
            groups[controller] = group
    for mount in mounts:
        fields, _, kind = mount.partition(" - ")
        point = Path(fields.split()[4])
        file_system, _, options = kind.split(" ", 2)
        if file_system == "cgroup2":
            group = groups.get("", "/")
        elif file_system == "cgroup" and "cpu" in options.split(","):
            group = groups.get("cpu", "/")
        else:
            continue
        yield from (point / part.relative_to("/") for part in (Path(group), *Path(group).parents))


def speed_file() -> Path:
    """Return the file that keeps the speed of this machine, in the user's cache."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "stickslip" / "machine-speed.json"


class SpeedGauge:
    """The speed of this machine, from a file or measured; measured again if it was disturbed.

    A machine that cannot be measured counts as the reference machine, and the log gives the reason.
    """

    def __init__(self, file: Path, slots: int) -> None:
        self._file = file
        self._processes = min(slots, MAX_PROCESSES)
        self._machine = machine_name()
        self._meter = CpuMeter()
        self.is_settled = False
        """Whether the speed needs no further measurement."""
        stored = self._read()
        if stored is None:
            self.speed = self._measure()
        else:
            self.speed = stored.speed
            self.is_settled = not stored.is_disturbed

    def settle(self) -> bool:
        """Measure a disturbed speed again if the CPUs have been quiet; return whether it did so.

        It takes a second, so call it when nothing else waits.
        """
        if self.is_settled or self._meter.seconds < QUIET_SECONDS:
            return False
        was_quiet = self._meter.other_share <= QUIET_SHARE
        if was_quiet:
            self.speed = self._measure()
        self._meter = CpuMeter()
        return was_quiet

    def _read(self) -> StoredSpeed | None:
        """Return the stored speed of this machine."""
        try:
            stored = StoredSpeed.model_validate_json(self._file.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            log.warning(
                "%s is not the speed of a machine, and is measured again: %s", self._file, error
            )
            return None
        return stored if stored.machine == self._machine else None

    def _measure(self) -> MachineSpeed:
        """Measure the speed, and store it with whether other programs disturbed it."""
        meter = CpuMeter()
        try:
            speed = measure_speed(self._processes)
        except (OSError, subprocess.SubprocessError) as error:
            log.warning("the speed of this machine is unknown: %s", error)
            self.is_settled = True
            return MachineSpeed()
        other_share = meter.other_share
        self.is_settled = other_share <= QUIET_SHARE
        self._store(speed)
        if not self.is_settled:
            log.info(
                "other programs used %.0f %% of the CPUs while the speed of this machine was "
                "measured; it is measured again when they rest",
                100 * other_share,
            )
        return speed

    def _store(self, speed: MachineSpeed) -> None:
        document = StoredSpeed(machine=self._machine, speed=speed, is_disturbed=not self.is_settled)
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._file.write_text(document.model_dump_json(), encoding="utf-8")
        except OSError as error:
            log.warning("the speed of this machine cannot be stored: %s", error)


class CpuMeter:
    """The share of all CPUs that other programs use, from the construction of the meter on."""

    def __init__(self) -> None:
        self._started_at = time.monotonic()
        self._busy_before = _busy_seconds()
        self._own_before = _own_seconds()

    @property
    def seconds(self) -> float:
        """Time since the construction [s]."""
        return time.monotonic() - self._started_at

    @property
    def other_share(self) -> float:
        """CPU time of others over that of all CPUs; 0 on systems that do not tell it.

        The ended children of this process are not others.
        """
        own_seconds = _own_seconds() - self._own_before
        busy_seconds = _busy_seconds() - self._busy_before
        return max(0.0, busy_seconds - own_seconds) / (self.seconds * (os.cpu_count() or 1))


def _own_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended [s]."""
    usages = (
        resource.getrusage(group) for group in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _busy_seconds() -> float:
    """Return the time for which all CPUs together were busy since the start of the system [s]."""
    try:
        first_line = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0]
    except OSError:  # the system is not Linux
        return 0.0
    # proc_stat(5): user, nice, system, idle, iowait, irq, softirq, steal, in ticks.
    user, nice, system, _idle, _iowait, irq, softirq, steal = map(int, first_line.split()[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def measure_speed(processes: int) -> MachineSpeed:
    """Run the drag alone, and in some processes at once; return the speed of the machine."""
    (alone,) = _time_drags(1)
    together = _time_drags(processes) if processes > 1 else [alone]
    cpu_seconds = sum(time.cpu_seconds for time in together) / len(together)
    wall_seconds = sum(time.wall_seconds for time in together) / len(together)
    cpu_available = min(1.0, cpu_seconds / wall_seconds)
    return MachineSpeed(
        cpu_speed=REFERENCE_CPU_SECONDS / cpu_seconds,
        cpu_available=cpu_available,
        # Of several processes, none has more than one that is alone.
        cpu_alone=max(cpu_available, min(1.0, alone.cpu_seconds / alone.wall_seconds)),
    )


def _time_drags(processes: int) -> list[DragTimes]:
    """Run the drag in some processes at the same time, and return the times of each."""
    command = [sys.executable, "-m", "stickslip_workers.machine"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    running = []
    for _ in range(processes):
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, env=environment))
    times = []
    for process in running:
        output, _ = process.communicate(timeout=TIMEOUT_SECONDS)
        if process.returncode != 0:
            raise subprocess.CalledProcessError(process.returncode, command)
        times.append(DragTimes.model_validate_json(output))
    return times


def drag() -> DragTimes:
    """Drop and drag a coarse cloth for a short time, and return the times."""
    from stickslip_sim_core.scenes import cloth_drag

    frames = round(DRAG_SECONDS * cloth_drag.FRAME_RATE) + 1
    scene = cloth_drag.scene("gray-interlock", 0.5, mesh=DRAG_VERTICES, frames=frames, seed=0)
    started_at = time.perf_counter()
    cpu_before = time.process_time()
    scene.run()
    cpu_seconds = time.process_time() - cpu_before
    return DragTimes(cpu_seconds=cpu_seconds, wall_seconds=time.perf_counter() - started_at)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(drag().model_dump()) + "\n")
