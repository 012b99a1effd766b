"""A store that is full, read-only or not to be written pauses jobs within seconds.

Then they go on by themselves.
"""

import errno
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
from stickslip_schemas.base import JobState, Reason
from stickslip_services.errors import ConflictError
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import HOLD_SECONDS, Context
from stickslip_services.queue.control import pause_job, resume_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.servers import RunningServer, start_server, wait_until
from stickslip_testing.worker import DirectApi, PretendWorker, failure

pytestmark = pytest.mark.databases(slow=True)

MIB = 2**20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 48 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", place], capture_output=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"mounting needs root: {done.stderr.decode()}")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


def fill(disk: Path, *, but: int = 0) -> Path:
    """Write a file until so many bytes are left."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file:
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_bsize
        with suppress(OSError):  # other writers are faster, perhaps
            for _ in range(0, free - but, 4096):
                file.write(bytes(4096))
    return ballast


def job_of(server: RunningServer, job: str) -> dict[str, object]:
    answer = httpx.get(f"{server.url}/v1/jobs/{job}", timeout=30, trust_env=False)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


@pytest.mark.real
@pytest.mark.parametrize("left", [0, 6 * MIB])
def test_a_full_disk_pauses_within_ten_seconds_and_room_lets_go_on(
    disk: Path, monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    """Database and store share the disk.

    With nothing left at all, not even the database can be written.
    """
    monkeypatch.setenv("STICKSLIP_MIN_FREE_BYTES", str(8 * MIB))
    server = start_server(disk / "data")
    try:
        worker = server.worker()
        job = httpx.post(f"{server.url}/v1/jobs", json=rods(), trust_env=False).json()["id"]
        ballast = fill(disk, but=left)
        begin = time.monotonic()
        wait_until(lambda: job_of(server, job)["reason"] == "store_unavailable", seconds=10)
        assert time.monotonic() - begin < 10
        detail = job_of(server, job)
        assert "must stay free" in str(detail["message"])
        if left:
            wait_until(lambda: job_of(server, job)["state"] == "paused", seconds=5)
            assert worker.lease() == ()
            refused = httpx.post(f"{server.url}/v1/jobs/{job}:resume", trust_env=False)
            assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
            assert "goes on by itself" in refused.json()["detail"]
        ballast.unlink()
        wait_until(lambda: job_of(server, job)["state"] in ("queued", "running"), seconds=10)
        wait_until(lambda: worker.work() > 0 and job_of(server, job)["state"] == "succeeded")
    finally:
        server.stop()


def test_a_read_only_store_pauses_the_job(disk: Path, tmp_path: Path) -> None:
    settings = Settings(
        data=tmp_path / "data", store=str(disk / "store"), durable=False, min_free_bytes=0
    )
    context = Context.open(settings, ManualClock())
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit_job(context, parsed(rods()), None).id  # type: ignore[union-attr]
    (lease,) = worker.lease(simulate=1)
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    with pytest.raises(OSError, match="Read-only") as raised:  # what a worker meets
        worker.result(lease.task)
    assert raised.value.errno == errno.EROFS
    worker.report((lease, failure(Reason.store_unavailable, str(raised.value))))
    assert worker.lease() == ()
    sweep(context)
    detail = show_job(context, job)
    assert detail.reason is Reason.store_unavailable
    assert "Read-only file system" in detail.message
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    context.clock.advance(HOLD_SECONDS + 1)  # type: ignore[attr-defined]
    sweep(context)
    worker.work()
    assert show_job(context, job).state is JobState.succeeded
    context.close()


def test_a_store_that_is_a_file_pauses_the_job(context: Context, worker: PretendWorker) -> None:
    """Works without root: every error of writing to the store is reported with its reason."""
    root = Path(context.settings.store_place)
    if root.exists():
        root.rmdir()
    root.write_text("in the way")
    job = submit_job(context, parsed(rods()), None).id  # type: ignore[union-attr]
    sweep(context)
    detail = show_job(context, job)
    assert (detail.state, detail.reason) == (JobState.paused, Reason.store_unavailable)
    assert "File exists" in detail.message
    root.unlink()
    sweep(context)
    assert show_job(context, job).state is JobState.queued
    assert show_job(context, job).message == ""


def test_a_job_from_before_the_first_worker_is_planned_once_the_store_is_free(
    context: Context,
) -> None:
    root = Path(context.settings.store_place)
    if root.exists():
        root.rmdir()
    root.write_text("in the way")
    job = submit_job(context, parsed(rods()), None).id  # type: ignore[union-attr]
    sweep(context)
    PretendWorker(DirectApi(context), context.store).register()
    root.unlink()
    sweep(context)
    assert show_job(context, job).state is JobState.queued
    assert show_job(context, job).message == ""


def test_a_store_that_only_a_worker_cannot_use_costs_no_try(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit_job(context, parsed(rods(gamma=(1.0,), phi1=(1.0,))), None).id  # type: ignore[union-attr]
    for _ in range(2 * context.settings.max_tries):
        (lease,) = worker.lease()
        worker.start(lease)
        worker.report((lease, failure(Reason.store_unavailable, "Permission denied")))
        assert worker.lease() == ()
        sweep(context)
        detail = show_job(context, job)
        assert (detail.state, detail.reason) == (JobState.paused, Reason.store_unavailable)
        assert "worker pretend cannot use the store: Permission denied" in detail.message
        with pytest.raises(ConflictError, match="goes on by itself"):
            resume_job(context, job)
        clock.advance(HOLD_SECONDS + 1)
        sweep(context)
        assert show_job(context, job).state is JobState.running
    worker.work()
    assert show_job(context, job).state is JobState.succeeded


def test_who_pauses_a_waiting_job_keeps_it_paused(context: Context, worker: PretendWorker) -> None:
    job = submit_job(context, parsed(rods()), None).id  # type: ignore[union-attr]
    context.store_watch.report("it is full")
    sweep(context)
    assert show_job(context, job).reason is Reason.store_unavailable
    assert pause_job(context, job).reason is None
    context.clock.advance(HOLD_SECONDS + 1)  # type: ignore[attr-defined]
    sweep(context)
    assert show_job(context, job).state is JobState.paused
