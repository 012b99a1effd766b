"""Downloads of the files of a manifest.

A file gets its name after its digest has been checked. An interrupted download continues: a `.part`
file holds the first bytes of a file, and the rest is requested by range. Nothing is written beyond
the size that the manifest states.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from stickslip_schemas.format.manifest import FileEntry
from stickslip_schemas.store import sync
from stickslip_schemas.transport.http import AnswerError, TransportError

from stickslip_services.client.errors import (
    ClientError,
    DamagedError,
    UnexpectedError,
    UnreachableError,
)
from stickslip_services.client.http import Client
from stickslip_services.client.verifying import CONNECTIONS, PART_SUFFIX, file_digest, safe_path

ATTEMPTS = 5
"""How often a file is requested before its download fails."""


@dataclass(frozen=True, slots=True)
class Downloader:
    """Downloads files of one version."""

    client: Client
    root: str
    """Path of the files in the API, with a slash at the end."""
    target: Path
    """Directory that files are written to."""
    on_bytes: Callable[[int], None]
    """Called with the number of bytes of each received block, by several threads."""
    stop: threading.Event

    def download_all(self, files: list[FileEntry]) -> None:
        """Download files, several at once; the first error stops all.

        Raises:
            DamagedError: A file arrives with other bytes than the manifest states.
            ClientError: The coordinator refused, or does not answer.
        """
        remaining = iter(files)
        lock = threading.Lock()

        def download_rest() -> None:
            while not self.stop.is_set():
                with lock:
                    file = next(remaining, None)
                if file is None:
                    return
                self._download(file)

        # One task for each thread: a task for each of a million files would fill the memory.
        with ThreadPoolExecutor(CONNECTIONS) as pool:
            tasks = [pool.submit(download_rest) for _ in range(min(CONNECTIONS, len(files)))]
            try:
                for task in as_completed(tasks):
                    task.result()
            except BaseException:
                self.stop.set()
                raise

    def _download(self, file: FileEntry) -> None:
        """Download a file to its `.part` file, check it, and rename it."""
        path = safe_path(self.target, file.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(path.name + PART_SUFFIX)
        # A link could lead out of the directory.
        if part.is_symlink():
            part.unlink()
        self.on_bytes(_size(part))
        # Pauses grow, so that a coordinator that restarts has time to do so.
        failure: ClientError = UnreachableError(f"{file.path} was not requested")
        for attempt in range(ATTEMPTS):
            pause = 0.0 if attempt == 0 else min(2.0**attempt / 4, self.client.retry_timeout)
            if self.stop.wait(pause):
                return
            try:
                self._fetch(file, part)
            except TransportError as error:
                failure = UnreachableError(
                    f"{file.path} could not be downloaded in {ATTEMPTS} attempts: the server "
                    f"{error}"
                )
                continue  # the part keeps the received bytes
            except AnswerError as error:
                raise UnexpectedError(str(error)) from error
            if self.stop.is_set():
                return
            # The size is compared first, because a digest reads the whole file.
            if _size(part) == file.size and file_digest(part) == file.sha256:
                sync(part)
                part.replace(path)
                return
            # A part of another file, or damaged on its way: start again.
            part.unlink(missing_ok=True)
            failure = DamagedError(
                f"{file.path} arrived {ATTEMPTS} times with other bytes than the manifest states"
            )
        raise failure

    def _fetch(self, file: FileEntry, part: Path) -> None:
        """Append the bytes of a file that its part lacks.

        Raises:
            TransportError: The connection failed.
            AnswerError: The body is compressed.
            DamagedError: The server sends more bytes than the manifest states.
        """
        # Only the bytes that an earlier attempt did not get are requested, and only if the file
        # is still the same.
        received = _size(part)
        headers = {}
        if received:
            headers = {"Range": f"bytes={received}-", "If-Range": f'"{file.sha256}"'}
        with self.client.stream(self.root + file.path, headers) as response:
            if response.status_code == 416:  # the part is at least as long as the file
                return
            self.client.check_status(response)
            is_rest = response.status_code == 206
            # A server that ignores the range sends all of the file.
            room = file.size - (received if is_rest else 0)
            with part.open("ab" if is_rest else "wb") as stream:
                for block in response.iter_raw():
                    # A broken connection loses bytes and adds none, so this is no accident.
                    if len(block) > room:
                        part.unlink()
                        raise DamagedError(
                            f"{file.path} has more than the {file.size} bytes that the manifest "
                            "states"
                        )
                    stream.write(block)
                    room -= len(block)
                    self.on_bytes(len(block))
                    if self.stop.is_set():
                        return


def _size(path: Path) -> int:
    """Return the size of a file [bytes]; 0 if it does not exist."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0
