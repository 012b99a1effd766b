"""The Ray cluster: one of our own on this machine, or one that is there already.

A cluster of our own ends with the dispatcher, also after SIGKILL: Ray's own processes get a signal or see their parent
gone. Two of its agents take up to a minute to see it; the next dispatcher of the same name ends them at once.
"""

import contextlib
import logging
import os
import secrets
import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stickslip_schemas.keys import sha256

log = logging.getLogger(__name__)

OBJECT_STORE_BYTES = 128 * 2**20
"""Tasks and results are small: bulk data goes through the store."""

OWNER = "STICKSLIP_RAY_OWNER"
"""Environment variable of all processes of a cluster of ours: its directory and the dispatcher's pid."""


@contextmanager
def ray_cluster(*, name: str, address: str | None, cpus: int | None) -> Iterator[int]:
    """Connect to the cluster at `address`, or start one with `cpus`; yield the number of its CPUs."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"  # a call after the end must not start another cluster
    if address is None:
        directory = _own_directory(name)
        _bury(directory)
        # Ray listens on every interface: without a token, whoever reaches the machine could run code on it.
        os.environ |= {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            OWNER: f"{directory}:{os.getpid()}",
        }
        options = {
            "num_cpus": cpus,
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
            "_temp_dir": str(directory),
        }
    else:
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        options = {"address": address}

    import ray  # after the environment is set

    ray.init(log_to_driver=False, logging_level=logging.WARNING, **options)
    try:
        yield int(ray.cluster_resources().get("CPU", 0))
    finally:
        ray.shutdown()


def _own_directory(name: str) -> Path:
    """Return a directory of ours with a path so short that Ray's sockets below it fit into 107 bytes."""
    root = Path(tempfile.gettempdir())
    if len(str(root)) > 20:
        root = Path("/tmp")
    root = root / f"stickslip-ray-{os.getuid()}"
    root.mkdir(mode=0o700, exist_ok=True)
    if root.stat().st_uid != os.getuid():
        raise PermissionError(f"{root} must belong to this user")
    directory = root / sha256(name.encode())[:8]
    directory.mkdir(exist_ok=True)
    return directory


def _bury(directory: Path) -> None:
    """End what a killed dispatcher of this name left behind, processes and files."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
        except OSError:  # gone, or not ours
            continue
        for variable in environment:
            key, _, value = variable.decode(errors="replace").partition("=")
            owned_by, _, pid = value.rpartition(":")
            if key == OWNER and owned_by == str(directory) and not Path("/proc", pid).exists():
                log.info("ending process %s of dispatcher %s, which is gone", entry.name, pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(entry.name), signal.SIGKILL)
    for session in directory.glob("session_*_*"):
        if not session.is_symlink() and not Path("/proc", session.name.rpartition("_")[2]).exists():
            shutil.rmtree(session, ignore_errors=True)
