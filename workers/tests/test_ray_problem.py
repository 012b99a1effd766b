"""What a dispatcher says of a Ray that does not answer."""

from pathlib import Path

from stickslip_workers.cluster import RayCluster


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
