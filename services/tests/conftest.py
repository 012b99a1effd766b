"""A coordinator on a temporary directory: in the process with a clock of its own, or as a server."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from stickslip_services.queue.coordinator import Coordinator
from stickslip_services.settings import Settings
from stickslip_services.testing import ManualClock, PretendWorker, RunningServer, start_server


@pytest.fixture(autouse=True)
def _quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test cuts the power, so none waits for the disk."""
    monkeypatch.setattr("os.fsync", lambda _descriptor: None)
    monkeypatch.setenv("STICKSLIP_DURABLE", "0")


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data=tmp_path / "data", durable=False)


@pytest.fixture
def coordinator(settings: Settings, clock: ManualClock) -> Iterator[Coordinator]:
    made = Coordinator(settings, clock)
    made.start()
    yield made
    made.close()


@pytest.fixture
def worker(coordinator: Coordinator) -> PretendWorker:
    """A registered worker that talks to the coordinator without HTTP."""
    return PretendWorker(coordinator, coordinator.store).register()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RunningServer]:
    """A coordinator of its own for one test."""
    running = start_server(tmp_path / "data")
    yield running
    running.stop()


@pytest.fixture(scope="module")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A coordinator for all tests of a module that do not disturb each other."""
    running = start_server(tmp_path_factory.mktemp("shared") / "data")
    yield running
    running.stop()
