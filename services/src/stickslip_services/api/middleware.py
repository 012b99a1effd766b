"""What a request passes before its route: limits on connections, an id, a timing, and
authorisation.

A request, headers and body, must arrive within `TURN_SECONDS` plus the time that its bytes take at
`LEAST_RATE`. Answers have no limit: event streams last as long as jobs.

A page of another site that is open in a browser on this machine can send requests to the
coordinator, but it cannot forge `Host` and `Origin`. The check of `Host` prevents DNS rebinding,
that of `Origin` cross-site request forgery.
"""

import asyncio
import re
import resource
import secrets
import time
from base64 import b64decode
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPMethod, HTTPStatus
from urllib.parse import urlsplit

from sqlalchemy.exc import OperationalError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Send
from starlette.types import Scope as HttpScope
from stickslip_schemas.documents.problems import MEDIA_TYPE, ProblemCode
from uvicorn.protocols.http.h11_impl import H11Protocol

from stickslip_services.access.keys import KeyRing
from stickslip_services.access.principals import Principal, Scope, acting_as
from stickslip_services.addresses import is_loopback
from stickslip_services.api.problems import ProblemError

TURN_SECONDS = 10.0
"""Time to send a request [s]..."""
LEAST_RATE = 64 * 2**10
"""...plus the time that its bytes take at this rate [bytes/s]."""
MOST_CONNECTIONS = 4000

IDLE_SECONDS = 15.0
"""A connection without a request is closed after so long [s]. Clients close theirs earlier, httpx
after 5 s: where both wait equally long, a request may meet a connection that is just being closed,
and fails."""

_REQUEST_ID = re.compile(r"[A-Za-z0-9_.:-]{1,128}")
_METHODS = frozenset(HTTPMethod)
_SAFE = ("GET", "HEAD", "OPTIONS")

_CHALLENGE = 'Bearer realm="stickslip", Basic realm="stickslip: a key as password"'
_HOW = (
    ", as `Authorization: Bearer KEY` or as the password of Basic; `stickslip keys create` makes keys, and local "
    "workers use the one in the file `worker-key` of the data directory"
)


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with limits on the duration of requests."""

    _timer: asyncio.TimerHandle | None = None
    _since = 0.0
    _received = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.timeout_keep_alive = IDLE_SECONDS  # type: ignore[assignment]
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            self._refuse(
                503,
                ProblemCode.busy,
                f"there are more than {MOST_CONNECTIONS} connections; try again later",
            )
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
            self.transport.write(
                f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\n{headers}\r\n".encode() + body
            )
        self.transport.close()


def allow_many_files() -> None:
    """Raise the limit of open files to its maximum: each connection is one."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


@dataclass(frozen=True, slots=True)
class RequestMiddleware:
    """Gives every request an id, the client's where it sent a sensible `X-Request-Id`, returns it,
    and takes the time.

    Every answer also forbids browsers to guess its type. `observe` gets method, template of the
    route, status and time.
    """

    app: ASGIApp
    observe: Callable[[str, str, int, float], None]

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        begin, status = time.perf_counter(), 500
        sent = Headers(scope=scope).get("x-request-id", "")
        request_id = sent if _REQUEST_ID.fullmatch(sent) else secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = request_id
                headers["X-Content-Type-Options"] = "nosniff"
            await send(message)

        try:
            await self.app(scope, receive, send_with_id)
        finally:
            route = getattr(scope.get("route"), "path", "unknown")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self.observe(method, route, status, time.perf_counter() - begin)


@dataclass(frozen=True, slots=True)
class OriginMiddleware:
    """Refuses requests for a foreign host name, and changes requested by pages of other sites."""

    app: ASGIApp
    allowed_hosts: tuple[str, ...] = ()

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        refusal = self._refusal(scope) if scope["type"] == "http" else None
        await (self.app if refusal is None else refusal.answer)(scope, receive, send)

    def _refusal(self, scope: HttpScope) -> ProblemError | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(host)
        if name is None or not (is_loopback(name) or name in self.allowed_hosts):
            detail = f"Host must be a loopback name such as 127.0.0.1, or one of STICKSLIP_ALLOWED_HOSTS; got {host[:100]!r}"
            return ProblemError(403, ProblemCode.host_not_allowed, detail)
        origin = headers.get("origin")
        if (
            origin is None
            or scope["method"] in _SAFE
            or urlsplit(origin).netloc.lower() == host.lower()
        ):
            return None
        detail = f"Origin must be that of the coordinator's own pages, http://{host[:100]}; got {origin[:100]!r}"
        return ProblemError(403, ProblemCode.origin_not_allowed, detail)


def _host_name(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


class KeyMiddleware:
    """Refuses requests without a key of the scope that they need.

    The scope follows from method and path alone, so that a new route is never open by mistake.
    Where no key is required, everybody on this machine may do everything except act as a worker.
    """

    def __init__(self, app: ASGIApp, ring: KeyRing, *, required: bool) -> None:
        self._app = app
        self._ring = ring
        self._open = frozenset[Scope]() if required else frozenset(Scope) - {Scope.work}

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        needed = needed_scope(scope["method"], scope["path"]) if scope["type"] == "http" else None
        if needed is None:
            await self._app(scope, receive, send)
            return
        try:
            admitted = await self._admitted(Headers(scope=scope), needed)
        except OperationalError:
            detail = "the coordinator cannot read its keys; its log says more"
            admitted = ProblemError(
                503, ProblemCode.storage_error, detail, headers={"Retry-After": "10"}
            )
        if isinstance(admitted, ProblemError):
            await admitted.answer(scope, receive, send)
            return
        with acting_as(admitted):
            await self._app(scope, receive, send)

    async def _admitted(self, headers: Headers, needed: Scope) -> Principal | ProblemError:
        """Return the holder of the request's key, or why the request is refused."""
        authorization = headers.get("authorization")
        if authorization is None:
            if needed in self._open:
                return Principal(scopes=self._open)
            return _unauthorized(f"the request needs a key of the scope `{needed}`")
        secret = _secret(authorization)
        if secret is None or self._ring.is_fresh:
            holder = None if secret is None else self._ring.holder_of(secret)
        else:
            holder = await run_in_threadpool(self._ring.holder_of, secret)
        if holder is None:
            return _unauthorized("the key is not known, or it was revoked")
        if needed in self._open or holder.may(needed):
            return holder
        has = ", ".join(scope for scope in Scope if scope in holder.scopes)
        detail = f"the request needs the scope `{needed}`, and the key has: {has}"
        return ProblemError(403, ProblemCode.scope_missing, detail)


def _unauthorized(why: str) -> ProblemError:
    return ProblemError(
        401, ProblemCode.unauthorized, f"{why}{_HOW}", headers={"WWW-Authenticate": _CHALLENGE}
    )


def needed_scope(method: str, path: str) -> Scope | None:
    """Return the scope that a request needs; None if it needs no key."""
    if path in ("/livez", "/readyz") or path.startswith("/static/"):
        return None
    if path.startswith("/v1/worker") and method not in _SAFE:
        return Scope.work
    if method in _SAFE or path == "/v1/jobs:validate":
        return Scope.read
    return Scope.admin if path.startswith("/v1/certificates") else Scope.submit


def _secret(authorization: str) -> str | None:
    """Return the secret of an Authorization header.

    Browsers send it as the password of a user of any name.
    """
    scheme, _, value = authorization.partition(" ")
    if scheme.lower() == "bearer":
        return value.strip() or None
    if scheme.lower() != "basic":
        return None
    try:
        return b64decode(value.strip(), validate=True).decode().partition(":")[2] or None
    except ValueError:
        return None
