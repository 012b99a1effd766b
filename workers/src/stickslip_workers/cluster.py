"""The Ray cluster, of which the dispatcher is a driver. Somebody else runs it: `ray_head` does for `stickslip up`."""

import logging
import os
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

RECONNECT_SECONDS, OWN_RECONNECT_SECONDS = "15", "2"
"""How long Ray looks for a head that is gone; then it ends the driver, and another one is started [s]. The next head of
this machine has another port."""

RETRY_SECONDS = 1.0
"""Time between two attempts to connect [s]."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a cluster is: at an address, or that of the head which `ray_head` runs in a directory."""

    address: str | None
    directory: Path | None = None

    def connect(self) -> None:
        """Wait until Ray answers, and become a driver of it."""
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"  # a call after the end must not start a cluster
        seconds = RECONNECT_SECONDS if self.directory is None else OWN_RECONNECT_SECONDS
        os.environ.setdefault("RAY_gcs_rpc_server_reconnect_timeout_s", seconds)
        if self.directory is not None:
            # With 0, Ray does not take another address of this machine for loopback.
            os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token"}
            os.environ["RAY_AUTH_TOKEN_PATH"] = str(self.directory / "token")
        elif {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys():
            os.environ.setdefault("RAY_AUTH_MODE", "token")  # `ray start` infers this from a token, `ray.init` does not
        else:
            os.environ.setdefault("RAY_AUTH_MODE", "disabled")
        import ray  # after the environment is set

        while True:
            try:
                address = self._address()
                _knock(address)
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
                log.info("no Ray at %s yet: %s", self, error)
                ray.shutdown()
                time.sleep(RETRY_SECONDS)
            else:
                return

    def _address(self) -> str:
        if self.directory is not None:
            return (self.directory / "address").read_text()
        return self.address or "auto"

    def trouble(self) -> str:
        """Return what its files say about a head that does not answer, or where it should be."""
        if self.directory is None:
            return f"none answers at {self._address()}"
        for name in ("raylet.err", "raylet.out", "gcs_server.out"):
            path = self.directory / "session_latest" / "logs" / name
            if path.is_file() and (lines := path.read_text(errors="replace").split("\n")[:-1]):
                return f"last line of {path}: {lines[-1][:300]}"
        return f"it has not written to {self.directory} yet"


def _knock(address: str) -> None:
    """Raise OSError where nobody listens: Ray itself would wait for long."""
    host, _, port = address.rpartition(":")
    if host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()


def nodes() -> dict[str, dict[str, Any]]:
    """Return what Ray says about each node that lives, by its id."""
    import ray

    return {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
