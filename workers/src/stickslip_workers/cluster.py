"""The Ray cluster: one of our own on this machine, or one that is there already.

A cluster of our own listens on loopback only. It ends with the dispatcher, also after SIGKILL: Ray's own processes get
a signal or see their parent gone. Two of its agents take up to a minute to see it; the next dispatcher of the same name
ends them at once.

Ray itself takes minutes to notice that a part of it has died, and some of its calls then never return. So the processes
of a cluster of our own are watched: where one is gone the dispatcher ends, and its supervisor starts another
one, with another cluster.
"""

import contextlib
import logging
import math
import os
import secrets
import shutil
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from stickslip_schemas.base.keys import sha256

log = logging.getLogger(__name__)

OBJECT_STORE_BYTES = 128 * 2**20
"""Tasks and results are small: bulk data goes through the store."""

OWNER = "STICKSLIP_RAY_OWNER"
"""Environment variable of all processes of a cluster of ours: its directory and the dispatcher's pid."""


WATCH_SECONDS = 0.5
"""Time between two looks at the processes of a cluster of our own [s]."""

START_WATCH_SECONDS = 0.2
"""The same while it starts [s]."""

LATE_SECONDS = 5.0
"""How long after the start processes are still looked for: agents are the last to take their names [s]."""

ASK_SECONDS = 2.0
"""Time between two questions to the GCS of a cluster that was there already [s]."""

FAILED_ASKS = 3
"""So many of them in a row without an answer, and the cluster counts as lost."""

LAST_SECONDS = 5.0
"""How long the dispatcher may still report what it has after its cluster was lost [s]."""

DEATH_INFO_MS = 30_000
"""How long Ray may look for the cause where the connection to a process broke: a lost node is no fault of a task."""

_ESSENTIAL = ("gcs/gcs_server", "raylet/raylet", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
"""Parts of the command lines of the processes without which a cluster does not work for long."""


_QUIET = {
    "RAY_prestart_worker_first_driver": "0",  # no process in reserve: ours are actors
    "RAY_task_events_report_interval_ms": "0",  # no history of tasks: nobody reads it
    "RAY_enable_metrics_collection": "0",
    "RAY_event_stats": "0",
    "RAY_raylet_report_resources_period_milliseconds": "1000",
    "RAY_gcs_pull_resource_loads_period_milliseconds": "10000",
    "RAY_memory_monitor_refresh_ms": "1000",
}
"""Settings of a cluster of ours. With Ray's own, its processes look around several times a second, which costs as much
as small tasks do."""

_UNNEEDED = ("ray/_private/log_monitor.py", "ray/autoscaler/_private/monitor.py")
"""Those of the processes that do nothing for us: output of workers stays in their files, and no node is added."""


class ClusterLostError(RuntimeError):
    """A process of Ray has died; nothing can be run any more."""


@dataclass(slots=True)
class Cluster:
    """A Ray cluster."""

    cpus: int = 0
    is_up: threading.Event = field(default_factory=threading.Event)
    """Set when it has started."""
    lost: str = ""
    """What of it is gone; empty while all is there."""
    closing: bool = False
    """Whether its processes are being ended on purpose."""


@contextmanager
def ray_cluster(*, name: str, address: str | None, cpus: int | None) -> Iterator[Cluster]:
    """Connect to the cluster at `address`, or start one with `cpus`."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"  # a call after the end must not start another cluster
    os.environ.setdefault("RAY_timeout_ms_task_wait_for_death_info", str(DEATH_INFO_MS))
    if address is None:
        directory = _own_directory(name)
        _bury(directory)
        # Without a token, every user of the machine could run code as this one. The name of the variable is Ray's: with
        # 0 it takes the loopback address for the node's, and all its processes listen there and nowhere else.
        os.environ |= _QUIET | {
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
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

    cluster = Cluster()
    if address is None:
        threading.Thread(target=_watch, args=(cluster,), name="watch", daemon=True).start()
    try:
        ray.init(log_to_driver=False, logging_level=logging.WARNING, **options)
    except ConnectionError as error:
        raise ClusterLostError(f"no Ray cluster answers at {address}: {error}") from error
    cluster.cpus = int(ray.cluster_resources().get("CPU", 0))
    if address is None:
        for pid in _processes(_UNNEEDED):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
    else:
        gcs = ray.get_runtime_context().gcs_address
        threading.Thread(target=_ask, args=(cluster, gcs), name="watch", daemon=True).start()
    cluster.is_up.set()
    try:
        yield cluster
    finally:
        cluster.closing = True
        if cluster.lost:  # Ray might wait for what is gone; the next dispatcher buries the rest
            _end()
        ray.shutdown()


def _watch(cluster: Cluster) -> None:
    """Wait until a process of the cluster is gone, and see that this one ends: at once while the cluster starts, for
    Ray would wait for it for 30 s, and soon when it is up.
    """
    processes: dict[int, str] = {}
    looking_until = math.inf
    while not (gone := [name for pid, name in processes.items() if _parent_of(pid) is None]):
        if time.monotonic() < looking_until:
            processes |= _processes(_ESSENTIAL)
        if cluster.is_up.is_set():
            looking_until = min(looking_until, time.monotonic() + LATE_SECONDS)
        time.sleep(WATCH_SECONDS if cluster.is_up.is_set() else START_WATCH_SECONDS)
    if cluster.closing:
        return
    if not cluster.is_up.is_set():
        log.error("%s died while the Ray cluster started: this dispatcher ends", gone[0])
        _end()
    _lose(cluster, gone[0])


def _ask(cluster: Cluster, gcs: str) -> None:
    """Wait until the GCS at an address does not answer any more, and see that this process ends soon after."""
    host, _, port = gcs.rpartition(":")
    failed = 0
    while failed < FAILED_ASKS:
        time.sleep(ASK_SECONDS)
        try:
            socket.create_connection((host.strip("[]"), int(port)), ASK_SECONDS).close()
            failed = 0
        except OSError:
            failed += 1
        if cluster.closing:
            return
    _lose(cluster, f"the Ray cluster at {gcs}")


def _lose(cluster: Cluster, what: str) -> None:
    cluster.lost = what
    log.error("%s is gone: this dispatcher ends, and another one starts as soon as there is a cluster", what)
    time.sleep(LAST_SECONDS)
    _end()


def _end() -> None:
    """End this process at once: what tidies up at its exit would wait for a cluster that is gone."""
    logging.shutdown()
    os._exit(1)


def _processes(parts: Collection[str]) -> dict[int, str]:
    """Return the processes of the cluster of this process that have one of these in their command lines, by pid."""
    parents = {pid: parent for pid in _pids() if (parent := _parent_of(pid)) is not None}
    found: dict[int, str] = {}
    for pid in parents:
        line = _command_line(pid)
        name = next((part for part in parts if part in line), None)
        if name is not None and os.getpid() in _ancestors(pid, parents):
            found[pid] = name.rpartition("/")[2].removeprefix("ray::")
    return found


def _ancestors(pid: int, parents: dict[int, int]) -> set[int]:
    found = set()
    while (pid := parents.get(pid, 0)) and pid not in found:
        found.add(pid)
    return found


def _pids() -> list[int]:
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]


def _command_line(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def _parent_of(pid: int) -> int | None:
    """Return the parent of a process that lives; None if there is none, or only its corpse."""
    try:
        state, parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return None
    return None if state in "ZX" else int(parent)


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
