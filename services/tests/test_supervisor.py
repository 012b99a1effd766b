"""`stickslip up` with real processes.

The dispatcher is a stub that prints its arguments and waits.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
from stickslip_testing.servers import wait_until

if TYPE_CHECKING:
    from stickslip_testing.postgresql import PostgresqlServer

STUB = """
import os, signal, sys, time
with open({log!r}, "a") as log:
    log.write(f"{{os.getpid()}} {{' '.join(sys.argv[1:])}}\\n")
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
while True:
    time.sleep(0.05)
"""

pytestmark = pytest.mark.real


class Up:
    def __init__(
        self, directory: Path, *, stub: str | None = None, data: str = "data", port: str = "0"
    ) -> None:
        self.data = directory / data
        self.log = directory / "dispatchers.log"
        program = directory / "stub.py"
        program.write_text(STUB.format(log=str(self.log)) if stub is None else stub)
        command = [
            sys.executable,
            "-m",
            "stickslip_services.cli",
            "up",
            "--data",
            str(self.data),
            "--port",
            port,
        ]
        command += ["--slots", "3", "--workers", f"{sys.executable} {program}"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    @property
    def url(self) -> str:
        return (self.data / "url").read_text().strip()

    def answers(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz").is_success
        except (OSError, httpx.TransportError):
            return False

    def dispatchers(self) -> list[int]:
        return self.started("dispatch")

    def started(self, command: str) -> list[int]:
        lines = (
            [line.split() for line in self.log.read_text().splitlines()]
            if self.log.exists()
            else []
        )
        return [int(words[0]) for words in lines if words[1] == command]

    def coordinator(self) -> int:
        needle = f"stickslip_services.app\0--data\0{self.data}\0".encode()
        for entry in Path("/proc").iterdir():
            try:
                if entry.name.isdecimal() and needle in (entry / "cmdline").read_bytes():
                    return int(entry.name)
            except OSError:
                continue
        return 0

    def stop(self, number: int = signal.SIGTERM) -> str:
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.communicate(timeout=100)[0]


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """One for the tests that follow each other: the last kills it."""
    running = Up(tmp_path_factory.mktemp("up"))
    wait_until(
        lambda: bool(running.dispatchers() and running.started("head")) and running.answers(),
        seconds=250,
    )
    yield running
    running.stop()


def is_running(pid: int) -> bool:
    try:
        return b") Z " not in Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return False


def test_up_starts_all_once(up: Up) -> None:
    port = up.url.rsplit(":", 1)[1]
    assert port != "0"
    words = sorted(line.partition(" ")[2] for line in up.log.read_text().splitlines())
    expected = (
        f"dispatch --once --ray-data {up.data} --url {up.url} --store {up.data / 'store'} "
        "--name local"
    )
    assert words == [
        f"{expected} --key-file {up.data / 'worker-key'}",
        f"head --ray-data {up.data} --cpus 3",
    ]
    assert (up.data / "logs" / "coordinator.log").exists()
    for data, at, message in (
        ("data", "0", "in use by another"),
        ("other", port, "cannot listen on"),
    ):
        second = Up(up.data.parent, data=data, port=at)
        assert message in second.process.communicate(timeout=150)[0]
        assert second.process.returncode == 1


def test_children_that_are_killed_come_back(up: Up) -> None:
    url, first, before = up.url, up.coordinator(), len(up.dispatchers())
    os.kill(first, signal.SIGKILL)
    os.kill(up.dispatchers()[-1], signal.SIGKILL)
    wait_until(
        lambda: (
            up.coordinator() not in (0, first) and up.answers() and len(up.dispatchers()) > before
        ),
        seconds=250,
    )
    assert up.url == url


def test_children_do_not_outlive_the_supervisor(up: Up) -> None:
    def pids() -> list[int]:
        return [up.dispatchers()[-1], up.started("head")[-1], up.coordinator()]

    before, children = len(up.dispatchers()), pids()
    assert all(is_running(pid) for pid in children)
    up.process.kill()
    wait_until(lambda: not any(is_running(pid) for pid in children))
    again = Up(up.data.parent)
    wait_until(lambda: again.answers() and len(again.dispatchers()) > before, seconds=250)
    children = pids()
    output = again.stop(signal.SIGINT)
    assert again.process.returncode == 0, output
    assert not any(is_running(pid) for pid in children)
    assert not (up.data / "url").exists()


def test_a_child_that_keeps_dying_ends_the_whole(tmp_path: Path) -> None:
    failing = Up(tmp_path, stub="import sys; sys.exit('no blender here')")
    output = failing.process.communicate(timeout=300)[0]
    assert failing.process.returncode == 1
    assert "no blender here" in output
    assert "exited with status 1" in output
    assert failing.coordinator() == 0


def test_only_the_coordinator_is_told_the_database(
    postgresql: "PostgresqlServer", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STICKSLIP_DATABASE", postgresql.clean())
    up = Up(tmp_path)
    try:
        wait_until(lambda: bool(up.dispatchers()) and up.answers(), seconds=250)
        coordinator, dispatcher = (
            Path(f"/proc/{pid}") for pid in (up.coordinator(), *up.dispatchers())
        )
        assert b"STICKSLIP_DATABASE" in (coordinator / "environ").read_bytes()
        assert b"postgresql" not in (coordinator / "cmdline").read_bytes()
        assert b"STICKSLIP_DATABASE" not in (dispatcher / "environ").read_bytes()
        assert not (up.data / "coordinator.sqlite3").exists()
    finally:
        up.stop()
