"""Limits on connections: their number, and the time that a client may take to send a request.

A request, headers and body, must arrive within `TURN_SECONDS` plus the time that its bytes take at `LEAST_RATE`.
Answers have no limit: event streams last as long as jobs.
"""

import asyncio
import resource
from contextlib import suppress
from http import HTTPStatus

from stickslip_schemas.documents.problems import MEDIA_TYPE, ProblemCode
from uvicorn.protocols.http.h11_impl import H11Protocol

from stickslip_services.api.problems import ProblemError

TURN_SECONDS = 10.0
"""Time to send a request [s]..."""
LEAST_RATE = 64 * 2**10
"""...plus the time that its bytes take at this rate [bytes/s]."""
MOST_CONNECTIONS = 4000

IDLE_SECONDS = 15.0
"""A connection without a request is closed after so long [s]. Clients close theirs earlier, httpx after 5 s: where both
wait equally long, a request may meet a connection that is just being closed, and fails."""


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with limits on the duration of requests."""

    _timer: asyncio.TimerHandle | None = None
    _since = 0.0
    _received = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.timeout_keep_alive = IDLE_SECONDS  # type: ignore[assignment]
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            self._refuse(503, ProblemCode.busy, f"there are more than {MOST_CONNECTIONS} connections; try again later")
        else:
            self._start_turn()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._received += len(data)
        if not self._is_clients_turn:
            self._end_turn()
        elif self._timer is None and not self.transport.is_closing():
            self._start_turn(len(data))

    def connection_lost(self, exc: Exception | None) -> None:
        self._end_turn()
        super().connection_lost(exc)

    @property
    def _is_clients_turn(self) -> bool:
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def _start_turn(self, received: int = 0) -> None:
        self._since, self._received = self.loop.time(), received
        self._timer = self.loop.call_later(TURN_SECONDS, self._check_turn)

    def _end_turn(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _check_turn(self) -> None:
        left = self._since + TURN_SECONDS + self._received / LEAST_RATE - self.loop.time()
        if left > 0:
            self._timer = self.loop.call_later(left, self._check_turn)
            return
        self._timer = None
        detail = f"a request must arrive within {TURN_SECONDS:g} s, or at {LEAST_RATE} bytes a second at least"
        self._refuse(408, ProblemCode.too_slow, detail)

    def _refuse(self, status: int, code: ProblemCode, detail: str) -> None:
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            body = ProblemError(status, code, detail).document().model_dump_json().encode()
            headers = f"Content-Type: {MEDIA_TYPE}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n"
            self.transport.write(f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\n{headers}\r\n".encode() + body)
        self.transport.close()


def allow_many_files() -> None:
    """Raise the limit of open files to its maximum: each connection is one."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
