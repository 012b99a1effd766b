"""Logs rotate by size and age, and every line is in exactly one of the files."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from stickslip_services.local.rotation import LogRotation, last_lines, numbered
from stickslip_services.settings import Settings
from stickslip_testing.servers import wait_until

WRITER = """
import logging, os, sys, time
from stickslip_schemas.logs import configure_logging
configure_logging()
pid = os.getpid()
for number in range(int(sys.argv[1])):
    logging.info("line %d of %d", number, pid)
    time.sleep(float(sys.argv[2]))
logging.info("end of %d", pid)
"""


def contents(log: Path) -> str:
    """Return all lines of a log and of its rotated files, the oldest first."""
    files = sorted(log.parent.glob(f"{log.name}.*"), key=lambda path: -int(path.suffix[1:]))
    return "".join(file.read_text() for file in [*files, log] if file.exists())


def written(log: Path) -> Counter[str]:
    """Return how often each line of the writers is in a log."""
    return Counter(
        line.partition("INFO root: ")[2]
        for line in contents(log).splitlines()
        if "INFO root: " in line
    )


def start(log: Path, count: int, pause: float) -> "subprocess.Popen[bytes]":
    with log.open("ab") as file:
        command = [sys.executable, "-c", WRITER, str(count), str(pause)]
        return subprocess.Popen(command, stdout=file, stderr=file)


def test_so_many_files_are_kept_and_the_oldest_goes(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    rotation = LogRotation(max_bytes=1024, max_seconds=1e9, files=3)
    for turn in range(6):
        log.write_text(f"turn {turn}\n" + "x" * 1024)
        rotation.rotate_if_due(log, time.time())
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "x.log",
        "x.log.1",
        "x.log.2",
        "x.log.3",
    ]
    assert [numbered(log, number).read_text()[:6] for number in (1, 2, 3)] == [
        "turn 5",
        "turn 4",
        "turn 3",
    ]
    # An empty log, and one that is not there, are left alone.
    (tmp_path / "empty.log").touch()
    rotation.rotate(tmp_path / "empty.log", 0.0)
    rotation.rotate_if_due(tmp_path / "none.log", 0.0)
    assert not list(tmp_path.glob("empty.log.*")) + list(tmp_path.glob("none*"))


def test_the_first_line_tells_the_age_of_a_log(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    rotation = LogRotation(max_bytes=10**9, max_seconds=86_400.0, files=3)
    log.write_text("2026-01-01T00:00:00.000Z INFO root: the first\n")
    day = 1_767_225_600.0  # 2026-01-01 [s since 1970]
    rotation.rotate_if_due(log, day + 86_399.0)
    assert not numbered(log, 1).exists()
    rotation.rotate_if_due(log, day + 86_400.0)
    assert numbered(log, 1).exists()
    # The new file begins with the time of its rotation, also after a restart.
    rotation.rotate_if_due(log, day + 2 * 86_400.0 - 1.0)
    assert not numbered(log, 2).exists()
    rotation.rotate_if_due(log, day + 2 * 86_400.0)
    assert numbered(log, 2).exists()
    # A log whose first line has no time is rotated by its size alone.
    log.write_text("Traceback (most recent call last):\n")
    rotation.rotate_if_due(log, day + 9 * 86_400.0)
    assert not numbered(log, 3).exists()


def test_an_error_shows_lines_from_before_a_rotation(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    log.write_text("one\ntwo\n\nthree\n")
    LogRotation(1, 1.0, files=1).rotate(log, 0.0)
    assert last_lines(log, 3)[:2] == ["two", "three"]
    assert "earlier lines are in x.log.1" in last_lines(log, 3)[2]
    assert last_lines(tmp_path / "none.log", 3) == []


def test_nothing_is_lost_while_a_process_writes(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    rotation = LogRotation(max_bytes=2048, max_seconds=1e9, files=1000)
    process = start(log, 20_000, 0.0)
    while process.poll() is None:
        rotation.rotate_if_due(log, time.time())
        time.sleep(0.002)
    assert process.returncode == 0
    assert len(list(tmp_path.glob("x.log.*"))) > 3
    lines_by_count = written(log)
    assert lines_by_count == Counter(
        [f"line {number} of {process.pid}" for number in range(20_000)] + [f"end of {process.pid}"]
    )


def test_nothing_is_lost_on_a_hangup_and_a_restart(tmp_path: Path) -> None:
    """As with logrotate: rename, SIGHUP; then the process is started again into the same file."""
    log = tmp_path / "x.log"
    expected: Counter[str] = Counter()
    for turn in range(3):
        process = start(log, 40, 0.01)
        wait_until(lambda turn=turn: len(written(log)) > 41 * turn + 10)  # type: ignore[misc]
        log.replace(numbered(log, 2 * turn + 10))
        process.send_signal(signal.SIGHUP)
        # The file has its name again before the next record.
        wait_until(log.exists)
        assert process.wait(100) == 0
        log.replace(numbered(log, 2 * turn + 11))
        expected.update([f"line {number} of {process.pid}" for number in range(40)])
        expected.update([f"end of {process.pid}"])
    assert written(log) == expected


def test_a_process_without_a_file_behind_it_ends_with_its_terminal() -> None:
    command = [sys.executable, "-c", WRITER, "100000", "0.01"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE)
    assert process.stderr is not None
    process.stderr.readline()
    process.send_signal(signal.SIGHUP)
    assert process.wait(100) == -signal.SIGHUP
    process.stderr.close()


@pytest.mark.real
def test_up_rotates_the_logs_of_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By size, on SIGHUP, and across the death of a child; no line is lost or doubled."""
    monkeypatch.setenv("STICKSLIP_LOG_BYTES", "4096")
    monkeypatch.setenv("STICKSLIP_LOG_FILES", "500")
    program = tmp_path / "stub.py"
    program.write_text(
        f"import sys\nsys.argv = ['stub', '1000000', '0.01']\n{WRITER}",
    )
    data = tmp_path / "data"
    command = [sys.executable, "-m", "stickslip_services.cli", "up", "--data", str(data)]
    command += ["--port", "0", "--workers", f"{sys.executable} {program}"]
    with (tmp_path / "up.log").open("wb") as out:
        up = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out)
    log = data / "logs" / "dispatcher.log"
    try:
        wait_until(lambda: len(list(log.parent.glob("dispatcher.log.*"))) >= 2, seconds=250)
        coordinator = data / "logs" / "coordinator.log"
        wait_until(lambda: coordinator.exists() and coordinator.stat().st_size > 0)
        before = len(list(coordinator.parent.glob("coordinator.log.*")))
        up.send_signal(signal.SIGHUP)
        wait_until(lambda: len(list(log.parent.glob("coordinator.log.*"))) > before)
        assert up.poll() is None
        first = next(iter(written(log))).rpartition(" ")[2]
        os.kill(int(first), signal.SIGKILL)
        wait_until(lambda: len({line.rpartition(" ")[2] for line in written(log)}) == 2)
    finally:
        up.terminate()
        up.wait(100)
    counts = written(log)
    assert set(counts.values()) == {1}
    for writer in {line.rpartition(" ")[2] for line in counts}:
        numbers = {int(line.split()[1]) for line in counts if line.endswith(f" of {writer}")}
        assert numbers == set(range(len(numbers)))


def test_the_settings_are_bounded() -> None:
    assert Settings().log_files == 5
    with pytest.raises(ValueError, match="log_files"):
        Settings(log_files=0)
    with pytest.raises(ValueError, match="log_bytes"):
        Settings(log_bytes=0)
