"""The Ray cluster that the dispatcher drives, and a head for one machine, for `stickslip up`."""

import contextlib
import logging
import os
import re
import secrets
import shutil
import signal
import socket
import stat
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stickslip_schemas.base import sha256

log = logging.getLogger(__name__)

RECONNECT_SECONDS = "15"
"""Time that Ray looks for a lost head [s].

Ray then ends the driver, and another driver starts.
"""

LOCAL_RECONNECT_SECONDS = "2"
"""The same for a head of this machine, whose next head has another port [s]."""

RETRY_SECONDS = 1.0
"""Time between two attempts to connect [s]."""


@dataclass(frozen=True, slots=True)
class RayCluster:
    """A cluster at an address, or a cluster whose head `run_head` runs in a directory."""

    location: str | Path
    log: Path | None = None
    """Log of the head, if `stickslip up` runs it."""

    def connect(self) -> None:
        """Wait until Ray answers, and become a driver of it."""
        os.environ |= {
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_ENABLE_AUTO_CONNECT": "0",
        }  # a late call starts no cluster
        if isinstance(self.location, Path):
            # With 0, Ray does not replace loopback by another address of this machine.
            os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token"}
            os.environ["RAY_AUTH_TOKEN_PATH"] = str(self.location / "token")
            seconds = LOCAL_RECONNECT_SECONDS
        else:  # `ray start` infers the mode from a token, `ray.init` does not
            has_token = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys()
            os.environ.setdefault("RAY_AUTH_MODE", "token" if has_token else "disabled")
            seconds = RECONNECT_SECONDS
        os.environ.setdefault("RAY_gcs_rpc_server_reconnect_timeout_s", seconds)
        import ray  # after the environment is set

        while True:
            try:
                address = (
                    self.location
                    if isinstance(self.location, str)
                    else (self.location / "address").read_text()
                )
                host, _, port = address.rpartition(":")
                if host:  # Ray itself would wait long for an unused port
                    socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
                handler = signal.getsignal(signal.SIGTERM)
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
                if threading.current_thread() is threading.main_thread():
                    signal.signal(
                        signal.SIGTERM, handler
                    )  # Ray has set its own handler, which exits at once
                return
            except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
                log.info("no Ray at %s yet: %s", self.location, error)
                ray.shutdown()
                time.sleep(RETRY_SECONDS)

    def describe_problem(self) -> str:
        """Return the last line in the files of a head that does not answer, or the address."""
        if isinstance(self.location, str):
            return f"none answers at {self.location}"
        logs = self.location / "session_latest" / "logs"
        if reason := find_reason(self.location):
            return reason
        # If a head does not even start its processes, only its own output gives the reason.
        paths = [logs / name for name in ("raylet.err", "raylet.out", "gcs_server.out")]
        for path in [*paths, *filter(None, [self.log])]:
            with contextlib.suppress(OSError):  # a new start of the head removes them
                if lines := path.read_text(errors="replace").split("\n")[:-1]:
                    return f"last line of {path}: {lines[-1][:300]}"
        return f"it has not written to {self.location} yet"


FATAL = re.compile(r"\] \(\w+\) [\w.]+:\d+: (?:Unhandled exception: )?(.*)")
"""A line of a log of Ray's processes: after the level and the place in the source, the message."""

LEAST_FREE_BYTES = 64 * 2**20
"""Space that Ray needs for its logs and sockets [bytes]; with less, they do not give the reason."""

MAX_REASON_LETTERS = 300
"""Longest reason that is shown."""


def find_reason(directory: Path) -> str:
    """Return why the processes of a head have ended, from their logs; an empty text if unknown."""
    logs = directory / "session_latest" / "logs"
    for name in ("raylet.err", "gcs_server.err", "raylet.out", "gcs_server.out"):
        with contextlib.suppress(OSError):
            for line in (logs / name).read_text(errors="replace").splitlines():
                # C is Ray's level of errors that end a process; other exceptions have a phrase.
                is_fatal = re.match(r"\[[\d-]+ [\d:,.]+ C ", line) or "Unhandled exception" in line
                if is_fatal and (match := FATAL.search(line)):
                    return f"{name.partition('.')[0]}: {match[1][:MAX_REASON_LETTERS]}"
    with contextlib.suppress(OSError):
        free_bytes = shutil.disk_usage(directory).free
        if free_bytes < LEAST_FREE_BYTES:
            return f"the file system of {directory} has {free_bytes / 1e6:.1f} MB left"
    return ""


def _print_reason(directory: Path) -> None:
    """Write the reason to the output of the head, of which `stickslip up` shows the last lines."""
    if reason := find_reason(directory):
        sys.stderr.write(f"Ray has ended: {reason}\n")
        sys.stderr.flush()


SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # everything listens on loopback, as on those systems
    # agents end with their raylet, at once
    "RAY_enable_pipe_based_agent_to_parent_health_check": "1",
    "RAY_worker_register_timeout_seconds": "600",  # Python may import slowly
    "RAY_enable_metrics_collection": "0",
    "RAY_event_stats": "0",
    "RAY_task_events_report_interval_ms": "0",  # no program reads the history of tasks
    "RAY_prestart_worker_first_driver": "0",
    # Ray also starts as many processes for waiting calls, and they come too late
    "RAY_num_workers_soft_limit": "0",
    # Blender takes seconds to start, so idle processes stay
    "RAY_idle_worker_killing_time_threshold_ms": "86400000",
    # small tasks cost less if Ray polls seldom
    "RAY_raylet_report_resources_period_milliseconds": "1000",
    "RAY_gcs_pull_resource_loads_period_milliseconds": "10000",
    "RAY_memory_monitor_refresh_ms": "1000",
}
"""Settings of a head for one machine."""


def head_directory(data: Path) -> Path:
    """Return the directory of the head of a data directory.

    Sockets below it must have paths of at most 107 bytes.
    """
    root = Path("/tmp") / f"stickslip-ray-{os.getuid()}"
    root.mkdir(mode=0o700, exist_ok=True)
    there = root.lstat()
    if there.st_uid != os.getuid() or not stat.S_ISDIR(there.st_mode) or there.st_mode & 0o077:
        raise PermissionError(
            f"{root} must be a directory of this user, which others cannot enter, and no link"
        )
    return root / sha256(str(data).encode())[:8]


OBJECT_STORE_BYTES = 128 * 2**20
"""Memory for the objects of Ray [bytes].

Tasks and results are small, and files go elsewhere.
"""

AGENT_PORTS = (
    "dashboard-agent-listen-port",
    "dashboard-agent-grpc-port",
    "runtime-env-agent-port",
    "metrics-export-port",
)
"""Options of `ray start` for the ports of a raylet's agents."""


def run_head(directory: Path, cpus: int | None) -> None:
    """Run `ray start --head --block` on loopback, with a token.

    Before the start, write `token` and `address` to the directory.
    """
    shutil.rmtree(directory, ignore_errors=True)  # an earlier head may have left files
    directory.mkdir(exist_ok=True)
    token = directory / "token"
    token.touch(mode=0o600)
    token.write_text(secrets.token_hex(32))
    os.environ |= SETTINGS | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
    from ray.scripts.scripts import cli

    port, *agent_ports = _free_ports(1 + len(AGENT_PORTS))
    _prepare_raylet(agent_ports[0], directory)
    options = {
        "port": port,
        "num-cpus": cpus or len(os.sched_getaffinity(0)),
        "node-ip-address": "127.0.0.1",
        "temp-dir": directory,
        "object-store-memory": OBJECT_STORE_BYTES,
        "include-dashboard": "false",
        "include-log-monitor": "false",
        **dict(zip(AGENT_PORTS, agent_ports, strict=True)),
    }
    (directory / "address").write_text(f"127.0.0.1:{port}")
    words = [f"--{name}={value}" for name, value in options.items()]
    try:
        cli.main(["start", "--head", "--block", "--no-monitor", *words], prog_name="ray")
    except SystemExit as end:
        if end.code:
            _print_reason(directory)
        raise


def _free_ports(count: int) -> list[int]:
    """Return free ports of loopback."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [int(listening.getsockname()[1]) for listening in sockets]
    for listening in sockets:
        listening.close()
    return ports


def _prepare_raylet(agent_port: int, directory: Path) -> None:
    """Let `ray start` of this process give a port to the raylet, and end with the raylet.

    `directory` is that of the head, with the logs of its processes.

    Ray 2.60 has no public way for either: no option, variable or hook of `ray start` reaches the
    command of the raylet. So this function wraps Ray's private function that starts processes:

    - The raylet waits 15 s for the ports of its Python process, and then aborts
      (ray-project/ray#65983). It does not wait for ports that it knows already. `ray start` passes
      on all of them except this one.
    - A raylet that has lost an agent exits with 0. `--block` takes this for an ordinary end.
    """
    from ray._private import services

    start = services.start_ray_process

    def start_ray_process(command: list[str], *arguments: object, **options: object) -> Any:
        if command[0] != services.RAYLET_EXECUTABLE:
            return start(command, *arguments, **options)
        raylet = start(
            [*command, f"--dashboard_agent_listen_port={agent_port}"], *arguments, **options
        )

        # This process ends with the raylet, and the kernel then ends its other children.
        def end_with_raylet() -> None:
            status = raylet.process.wait() or 1
            _print_reason(directory)
            os._exit(status)

        threading.Thread(target=end_with_raylet, daemon=True).start()
        return raylet

    services.start_ray_process = start_ray_process
