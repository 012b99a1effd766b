"""The Ray cluster, of which the dispatcher is a driver. Somebody else runs it: `ray_head` does for `stickslip up`."""

import contextlib
import logging
import os
import signal
import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path

log = logging.getLogger(__name__)

RECONNECT_SECONDS, OWN_RECONNECT_SECONDS = "15", "2"
"""How long Ray looks for a head that is gone; then it ends the driver, and another one is started [s]. The next head of
this machine has another port."""

RETRY_SECONDS = 1.0
"""Time between two attempts to connect [s]."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a cluster is: at an address, or that of the head which `ray_head` runs in a directory."""

    where: str | Path

    def connect(self) -> None:
        """Wait until Ray answers, and become a driver of it."""
        os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_AUTO_CONNECT": "0"}  # a late call starts no cluster
        if isinstance(self.where, Path):
            # With 0, Ray does not take another address of this machine for loopback.
            os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token"}
            os.environ["RAY_AUTH_TOKEN_PATH"] = str(self.where / "token")
            seconds = OWN_RECONNECT_SECONDS
        else:  # `ray start` infers the mode from a token, `ray.init` does not
            has_token = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys()
            os.environ.setdefault("RAY_AUTH_MODE", "token" if has_token else "disabled")
            seconds = RECONNECT_SECONDS
        os.environ.setdefault("RAY_gcs_rpc_server_reconnect_timeout_s", seconds)
        import ray  # after the environment is set

        while True:
            try:
                address = self.where if isinstance(self.where, str) else (self.where / "address").read_text()
                host, _, port = address.rpartition(":")
                if host:  # Ray itself would wait for long where nobody listens
                    socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
                handler = signal.getsignal(signal.SIGTERM)
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
                if threading.current_thread() is threading.main_thread():
                    signal.signal(signal.SIGTERM, handler)  # Ray has put its own in place, which exits at once
                return
            except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
                log.info("no Ray at %s yet: %s", self.where, error)
                ray.shutdown()
                time.sleep(RETRY_SECONDS)

    def trouble(self) -> str:
        """Return what its files say about a head that does not answer, or where it should be."""
        if isinstance(self.where, str):
            return f"none answers at {self.where}"
        for name in ("raylet.err", "raylet.out", "gcs_server.out"):
            path = self.where / "session_latest" / "logs" / name
            with contextlib.suppress(OSError):  # a head that starts again removes them
                if lines := path.read_text(errors="replace").split("\n")[:-1]:
                    return f"last line of {path}: {lines[-1][:300]}"
        return f"it has not written to {self.where} yet"
