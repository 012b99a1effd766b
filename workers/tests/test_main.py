"""A dispatcher on somebody else's cluster starts again when it dies.

One that asks a cluster notices its end.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stickslip_workers.lease_client import Backoff

PROGRAM = """
import sys
from pathlib import Path
from stickslip_workers.__main__ import run_for_ever
from stickslip_workers.lease_client import Backoff
sys.exit(run_for_ever([sys.executable, "-c", sys.argv[1], sys.argv[2]], Backoff(first=0.01)))
"""
CHILD = """
import os, sys, time
with open(sys.argv[1], "a") as file:
    number = len(open(sys.argv[1]).read().split())
    file.write(f"{os.getpid()}\\n")
%s
"""


def run(tmp_path: Path, end: str) -> "subprocess.Popen[bytes]":
    return subprocess.Popen([sys.executable, "-c", PROGRAM, CHILD % end, str(tmp_path / "pids")])


def test_it_starts_again_until_it_ends_well(tmp_path: Path) -> None:
    # First as if it had failed, then as if something had killed it, then well.
    process = run(
        tmp_path,
        "[lambda: sys.exit(1), lambda: os.kill(os.getpid(), 9), lambda: sys.exit(0)][number]()",
    )
    assert process.wait(60) == 0
    assert len((tmp_path / "pids").read_text().split()) == 3


def test_what_makes_no_sense_is_not_tried_again(tmp_path: Path) -> None:
    assert run(tmp_path, "sys.exit(2)").wait(60) == 2
    assert len((tmp_path / "pids").read_text().split()) == 1


def test_a_signal_is_passed_on(tmp_path: Path) -> None:
    process = run(tmp_path, "time.sleep(600)")
    pids = tmp_path / "pids"
    deadline = time.monotonic() + 60
    while not (pids.exists() and pids.read_text().endswith("\n")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == -signal.SIGTERM % 256
    with pytest.raises(ProcessLookupError):
        os.kill(int(pids.read_text()), 0)


def test_waits_grow() -> None:
    backoff = Backoff(first=1.0, most=30.0)
    for _ in range(20):
        backoff.failed()
    assert backoff.next_try - time.monotonic() <= 30.0
