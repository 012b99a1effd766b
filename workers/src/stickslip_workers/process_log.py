"""What a process of Ray wrote before it died: the end of its log, for the message of its task."""

from dataclasses import dataclass
from pathlib import Path

TAIL_BYTES = 16_384
"""End of a log that is read [bytes]."""

TAIL_LINES = 20
"""Most lines of a log in a message: a traceback of Python's `faulthandler` has about ten."""

TAIL_LETTERS = 1200
"""Most letters of a log in a message, so that the coordinator keeps all of it."""

FATAL = "Fatal Python error: "
"""Begins the line with which `faulthandler` names the signal that ended a process."""

NOISE = "Extension modules: "
"""Begins the line in which `faulthandler` lists all compiled modules: over 1,000 letters."""


@dataclass(frozen=True, slots=True)
class ProcessLog:
    """The file with the errors of a process, from where a call began to write."""

    path: str = ""
    """Empty if it is not known."""
    start: int = 0
    """Size of the file when the call began [bytes]."""

    def tail(self) -> str:
        """Return the last lines of the call; empty if there are none.

        The line that names a fatal signal comes first, however long the traceback below it is. A
        log of another machine is not read: its path does not exist here.
        """
        try:
            with Path(self.path).open("rb") as file:
                size = file.seek(0, 2)
                file.seek(max(self.start, size - TAIL_BYTES))
                text = file.read().decode("utf-8", errors="replace")
        except OSError:
            return ""
        lines = [line for line in text.splitlines() if line.strip() and not line.startswith(NOISE)]
        tail = "\n".join(lines[-TAIL_LINES:])[-TAIL_LETTERS:]
        fatal = next((line for line in reversed(lines) if line.startswith(FATAL)), "")
        if not fatal or fatal in tail:
            return tail
        return f"{fatal}\n{tail[len(fatal) + 1 :]}"
