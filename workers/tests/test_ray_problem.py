"""What a dispatcher says of a Ray that does not answer."""

import shutil
from pathlib import Path

import pytest
from stickslip_workers.cluster import RayCluster, find_reason


def test_a_head_that_does_not_start_is_quoted(tmp_path: Path) -> None:
    """Without files of its processes, its own output says why."""
    log = tmp_path / "ray.log"
    cluster = RayCluster(tmp_path / "head", log=log)
    assert cluster.describe_problem() == f"it has not written to {tmp_path / 'head'} yet"
    log.write_text("starting\nOSError: no space left for the object store\n")
    assert (
        cluster.describe_problem()
        == f"last line of {log}: OSError: no space left for the object store"
    )
    logs = tmp_path / "head" / "session_latest" / "logs"
    logs.mkdir(parents=True)
    (logs / "raylet.err").write_text("cannot register with the head\n")
    assert (
        cluster.describe_problem()
        == f"last line of {logs / 'raylet.err'}: cannot register with the head"
    )


def test_the_reason_is_the_fatal_line_and_no_frame_of_a_stack(tmp_path: Path) -> None:
    logs = tmp_path / "session_latest" / "logs"
    logs.mkdir(parents=True)
    assert find_reason(tmp_path) == ""
    (logs / "gcs_server.err").write_text(
        "[2026-01-01 10:00:00,000 E 1 1] (gcs_server) gcs_server.cc:1361: Failed to establish "
        "connection to the event+metrics exporter agent\n"
        "[2026-01-01 10:00:01,000 E 1 1] (gcs_server) logging.cc:118: Unhandled exception: "
        "N5boost. what(): eventfd_select_interrupter: Too many open files\n"
        "[2026-01-01 10:00:01,000 E 1 1] (gcs_server) logging.cc:125: Stack trace:\n"
    )
    assert find_reason(tmp_path) == (
        "gcs_server: N5boost. what(): eventfd_select_interrupter: Too many open files"
    )
    (logs / "raylet.err").write_text(
        "[2026-01-01 10:00:00,000 C 4985 4995] (raylet) dlmalloc.cc:161: create_buffer failed to "
        "open file /dev/shm/plasma, errorRead-only file system\n"
        "*** StackTrace Information ***\n"
        "/usr/lib/libc.so.6(+0x891f5) [0x7ffb]\n"
    )
    reason = "create_buffer failed to open file /dev/shm/plasma, errorRead-only file system"
    assert find_reason(tmp_path) == f"raylet: {reason}"
    assert RayCluster(tmp_path).describe_problem() == f"raylet: {reason}"


def test_a_full_file_system_is_the_reason_where_no_log_could_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=2_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: usage)
    assert find_reason(tmp_path) == f"the file system of {tmp_path} has 2.0 MB left"
