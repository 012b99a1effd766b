"""The coordinator's side of inspections: files go to a program that decodes them with limits.

See `catalog/inspection.py` for the program.
"""

import atexit
import json
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
from typing import IO, Any

from stickslip_schemas.scene.errors import UnfitFileError

logger = logging.getLogger(__name__)

MAX_PROCESSES = 2
"""Files that are decoded at the same time: 2 x 250 MB for pictures of 4,096 x 4,096 pixels."""

ANSWER_SECONDS = 60.0
"""Time that an inspection may take [s]: its CPU time is limited, but other processes may have all
cores.
"""


class Inspector:
    """Has files decoded by another process. Thread-safe; the program starts with the first file."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._turns = threading.BoundedSemaphore(MAX_PROCESSES)
        self._program: subprocess.Popen[bytes] | None = None
        self._requests: socket.socket | None = None

    def inspect(self, file: IO[bytes], question: dict[str, Any]) -> object:
        """Return the result of an inspection of a file; raise UnfitFileError.

        `question` names the inspection and its parameters.
        """
        with self._turns:
            answer = self._ask(file, question)
        if answer is None:
            raise UnfitFileError(
                "must be read within 10 s of CPU time and 512 MiB of memory, and reading it failed"
            )
        if "failure" in answer:
            logger.error("a file cannot be inspected:\n%s", answer["failure"])
            raise UnfitFileError("must be a file that can be read; the coordinator's log says more")
        if "unfit" in answer:
            raise UnfitFileError(answer["unfit"])
        return answer["result"]

    def inspect_bytes(self, data: bytes, question: dict[str, Any]) -> object:
        """Return the result of an inspection of data; raise UnfitFileError."""
        with tempfile.TemporaryFile() as file:
            file.write(data)
            file.flush()
            return self.inspect(file, question)

    def close(self) -> None:
        """End the program."""
        with self._lock:
            self._end()

    def _ask(self, file: IO[bytes], question: dict[str, Any]) -> dict[str, Any] | None:
        """Return the answer of the program; None if the process of the file died."""
        channel, far_end = socket.socketpair()
        with channel:
            with far_end, self._lock:
                requests = self._running()
                socket.send_fds(requests, [b"?"], [file.fileno(), far_end.fileno()])
            channel.settimeout(ANSWER_SECONDS)
            try:
                channel.sendall(json.dumps(question).encode())
                channel.shutdown(socket.SHUT_WR)
                with channel.makefile("rb") as reader:
                    text = reader.read()
            # The process reached a limit and was killed.
            except (ConnectionError, TimeoutError):
                return None
        answer: dict[str, Any] | None = json.loads(text) if text else None
        return answer

    def _running(self) -> socket.socket:
        """Return the socket of the program, which is started if it does not run."""
        if self._program is not None and self._program.poll() is None:
            assert self._requests is not None
            return self._requests
        self._end()
        self._requests, far_end = socket.socketpair()
        # The program decodes files of strangers: it gets no key and no password.
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith("STICKSLIP_")
        }
        module = "stickslip_services.catalog.inspection"
        with far_end:
            self._program = subprocess.Popen(
                [sys.executable, "-m", module, str(far_end.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[far_end.fileno()],
                env=environment | {"OPENBLAS_NUM_THREADS": "1"},
            )
        return self._requests

    def _end(self) -> None:
        if self._requests is not None:
            self._requests.close()  # the program ends when its socket does
            self._requests = None
        if self._program is not None:
            self._program.wait()
            self._program = None


INSPECTOR = Inspector()
"""The inspector of this process: one program is enough for all applications in it."""

atexit.register(INSPECTOR.close)
