"""The lock of a data directory: one coordinator, or one `stickslip up`, at a time."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stickslip_services.errors import DatabaseRefusedError


@contextmanager
def locked(data: Path) -> Iterator[int]:
    """Hold the lock of a data directory; the coordinator inherits it, so that it is held while one of them lives.

    Yield its file descriptor; raise DatabaseRefusedError where another process holds it.
    """
    data.mkdir(parents=True, exist_ok=True)
    path = data / "lock"
    with path.open("a+") as file:
        deadline = time.monotonic() + 10
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = path.read_text(encoding="utf-8").strip()
                # If the holder was killed, its coordinator is about to follow it.
                if _is_alive(holder) or time.monotonic() > deadline:
                    message = f"{path.parent} is in use by another `stickslip up` or coordinator (pid {holder})"
                    raise DatabaseRefusedError(message) from None
                time.sleep(0.1)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        os.set_inheritable(file.fileno(), True)
        yield file.fileno()


def _is_alive(pid: str) -> bool:
    if not pid.isdecimal():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
