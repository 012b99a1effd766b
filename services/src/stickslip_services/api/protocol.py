"""HTTP/1.1 with limits on the number of connections and on the time that a request may take.

A request, headers and body, must arrive within `TURN_SECONDS` plus the time that its bytes take at
`MIN_RATE`. Answers have no limit, because an event stream lasts as long as its job.
"""

import asyncio
import resource
from contextlib import suppress
from http import HTTPStatus

from stickslip_schemas.documents.problems import MEDIA_TYPE, ProblemCode
from uvicorn.protocols.http.h11_impl import H11Protocol

from stickslip_services.api.problems import ProblemError

TURN_SECONDS = 10.0
"""Time that a client has to send a request [s], plus the time that its bytes take at `MIN_RATE`."""

MIN_RATE = 64 * 2**10
"""Slowest rate at which a client may send a long request [bytes/s]."""

MAX_CONNECTIONS = 4000
"""Open connections. Each one is an open file and about 30 kB of memory."""

IDLE_SECONDS = 15.0
"""The coordinator closes a connection without a request after this time [s].

Clients close theirs earlier, httpx after 5 s. If both waited equally long, a request could meet a
connection that is just being closed, and fail."""


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with limits on the duration of requests."""

    _timer: asyncio.TimerHandle | None = None
    _turn_began_at = 0.0
    _received_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, or refuse it with 503 if there are too many."""
        self.timeout_keep_alive = IDLE_SECONDS  # type: ignore[assignment]
        super().connection_made(transport)
        if len(self.connections) <= MAX_CONNECTIONS:
            self._start_turn()
            return
        detail = f"there are more than {MAX_CONNECTIONS} connections; try again later"
        self._refuse(503, ProblemCode.busy, detail)

    def data_received(self, data: bytes) -> None:
        """Count the bytes of a request, and time it until it is complete."""
        super().data_received(data)
        self._received_bytes += len(data)
        if not self._is_turn_of_client:
            self._end_turn()
        elif self._timer is None and not self.transport.is_closing():
            # The first bytes of the next request on this connection.
            self._start_turn(len(data))

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer of a connection that has ended."""
        self._end_turn()
        super().connection_lost(exc)

    @property
    def _is_turn_of_client(self) -> bool:
        """Whether the next bytes must come from the client."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def _start_turn(self, received_bytes: int = 0) -> None:
        self._turn_began_at = self.loop.time()
        self._received_bytes = received_bytes
        self._timer = self.loop.call_later(TURN_SECONDS, self._check_turn)

    def _end_turn(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _check_turn(self) -> None:
        # The deadline moves with each byte that has arrived.
        deadline = self._turn_began_at + TURN_SECONDS + self._received_bytes / MIN_RATE
        remaining = deadline - self.loop.time()
        if remaining > 0:
            self._timer = self.loop.call_later(remaining, self._check_turn)
            return
        self._timer = None
        detail = (
            f"a request must arrive within {TURN_SECONDS:g} s, "
            f"or at {MIN_RATE} bytes a second at least"
        )
        self._refuse(408, ProblemCode.too_slow, detail)

    def _refuse(self, status: int, code: ProblemCode, detail: str) -> None:
        """Answer with a problem document and close the connection.

        No middleware runs, since there is no complete request. An answer that has begun is only cut
        off.
        """
        has_begun = (
            self.cycle is not None
            and self.cycle.response_started
            and not self.cycle.response_complete
        )
        if not has_begun:
            body = ProblemError(status, code, detail).document().model_dump_json().encode()
            lines = [
                f"HTTP/1.1 {status} {HTTPStatus(status).phrase}",
                f"Content-Type: {MEDIA_TYPE}",
                f"Content-Length: {len(body)}",
                "Cache-Control: no-store",
                "Connection: close",
            ]
            self.transport.write("\r\n".join([*lines, "", ""]).encode() + body)
        self.transport.close()


def allow_many_files() -> None:
    """Raise the limit of open files to its maximum: each connection is one."""
    _, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard_limit, hard_limit))
