"""Process setup of the programs on a machine: memory, the lock of a data directory, a listening socket, and the log."""

import ctypes
import fcntl
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stickslip_services.errors import DatabaseRefusedError, ListeningError

_M_ARENA_MAX = -8  # of glibc's malloc.h


def limit_arenas() -> None:
    """Let all threads allocate from two arenas of glibc. With one for each, every arena keeps memory that it freed."""
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


@contextmanager
def locked(data: Path) -> Iterator[int]:
    """Hold the lock of a data directory, which one coordinator or one `stickslip up` may use at a time.

    Yield the file descriptor of the lock. A process that inherits it holds the lock, too, until it ends.
    Raise DatabaseRefusedError if another process holds it.
    """
    data.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = data / "lock"
    with path.open("a+") as file:
        deadline = time.monotonic() + 10
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = path.read_text(encoding="utf-8").strip()
                # After a kill of `stickslip up`, its coordinator holds the lock for another moment.
                if Path("/proc", holder or "nobody").exists() or time.monotonic() > deadline:
                    message = f"{path.parent} is in use by another `stickslip up` or coordinator (pid {holder})"
                    raise DatabaseRefusedError(message) from None
                time.sleep(0.1)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield file.fileno()


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to a port, but does not accept connections yet; raise ListeningError."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
    except OSError as error:
        listener.close()
        rule = f"cannot listen on {host}:{port}: {error.strerror}. `--port 0` takes any free port."
        raise ListeningError(rule) from error
    return listener


def configure_logging() -> None:
    """Log to standard error, one event a line: `time level logger: message`, in UTC."""
    formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.getLogger("alembic").setLevel(logging.WARNING)
