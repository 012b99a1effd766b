"""Steps that a request passes before its route: its address, an id, a timing, privacy, origin, key.

A page of another site that is open in a browser on this machine can send requests to the
coordinator, but it cannot forge `Host` and `Origin`. The check of `Host` prevents DNS rebinding,
the check of `Origin` prevents cross-site request forgery.
"""

import re
import secrets
import time
from base64 import b64decode
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPMethod
from urllib.parse import urlsplit

from sqlalchemy.exc import OperationalError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Send
from starlette.types import Scope as HttpScope
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.transport.addresses import is_loopback

from stickslip_services import addresses
from stickslip_services.access.keys import KeyRing
from stickslip_services.access.principals import Principal, Scope, acting_as
from stickslip_services.api.problems import ProblemError
from stickslip_services.errors import InvalidKeyError

STATIC_PATH = "/static/"
"""Path of the scripts and styles of the pages: the only answers that are the same for everybody."""

FORWARDED_SCHEMES = ("http", "https")
"""Schemes of a client that a proxy may report."""

_REQUEST_ID = re.compile(r"[A-Za-z0-9_.:-]{1,128}")
_METHODS = frozenset(HTTPMethod)
_SAFE_METHODS = ("GET", "HEAD", "OPTIONS")

_CHALLENGE = 'Bearer realm="stickslip", Basic realm="stickslip: a key as password"'
_KEY_HELP = (
    ", as `Authorization: Bearer KEY` or as the password of Basic; `stickslip keys create` makes "
    "keys, and local workers use the one in the file `worker-key` of the data directory"
)


@dataclass(frozen=True, slots=True)
class AddressMiddleware:
    """Notes how the client addresses the coordinator, and takes the prefix off the path.

    The prefix is that of `X-Forwarded-Prefix`, or else the setting `root_path`. It must come
    first: all other steps, the check of keys too, judge the path that the routes see.
    """

    app: ASGIApp
    root_path: str = ""

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        forwarded = headers.get("x-forwarded-prefix")
        try:
            prefix = self.root_path if forwarded is None else addresses.checked_prefix(forwarded)
        except ValueError as error:
            # A wrong prefix is a fault of the proxy's configuration, and links would lead nowhere.
            detail = f"X-Forwarded-Prefix {error}"
            refusal = ProblemError(400, ProblemCode.validation_failed, detail)
            await refusal.answer(scope, receive, send)
            return
        scheme = headers.get("x-forwarded-proto", "").lower()
        if scheme not in FORWARDED_SCHEMES:
            scheme = scope["scheme"]
        origin = f"{scheme}://{headers.get('host', '')}"
        addresses.enter(addresses.Address(origin, prefix))
        own_path = addresses.without_prefix(scope["path"], prefix)
        await self.app({**scope, "path": own_path}, receive, send)


@dataclass(frozen=True, slots=True)
class RequestMiddleware:
    """Gives every request an id, returns it in `X-Request-Id`, and measures the time.

    The id is that of the client if it sent a well-formed `X-Request-Id`. Every answer also forbids
    browsers to guess its type, and shared caches to keep it. `observe` gets the method, the
    template of the route, the status and the time [s].
    """

    app: ASGIApp
    observe: Callable[[str, str, int, float], None]

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        began_at = time.perf_counter()
        status = 500
        client_id = Headers(scope=scope).get("x-request-id", "")
        request_id = client_id if _REQUEST_ID.fullmatch(client_id) else secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = request_id
                headers["X-Content-Type-Options"] = "nosniff"
                if not scope["path"].startswith(STATIC_PATH):
                    keep_from_shared_caches(headers)
            await send(message)

        try:
            await self.app(scope, receive, send_with_headers)
        finally:
            route = getattr(scope.get("route"), "path", "unknown")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self.observe(method, route, status, time.perf_counter() - began_at)


def keep_from_shared_caches(headers: MutableHeaders) -> None:
    """Forbid shared caches to keep an answer [RFC 9111, 3 and 5.2.2].

    An answer depends on the key, so a proxy that kept it would give it to other projects, and to
    anybody without a key. Refusals count too: a 404 for one project is a 200 for another. Routes
    may allow a browser to keep an answer (`private`); all others are `no-store`.
    """
    directives = {word.strip() for word in headers.get("cache-control", "").lower().split(",")}
    is_private = bool(directives & {"private", "no-store"}) and "public" not in directives
    if not is_private:
        headers["Cache-Control"] = "no-store"
    # A browser keeps a private answer for the key with which it asked.
    headers.add_vary_header("Authorization")


@dataclass(frozen=True, slots=True)
class OriginMiddleware:
    """Refuses requests for a foreign host name, and changes requested by pages of other sites."""

    app: ASGIApp
    allowed_hosts: tuple[str, ...] = ()

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        refusal = self._refusal(scope) if scope["type"] == "http" else None
        if refusal is None:
            await self.app(scope, receive, send)
        else:
            await refusal.answer(scope, receive, send)

    def _refusal(self, scope: HttpScope) -> ProblemError | None:
        # By DNS rebinding, a page of another site reaches this machine under its own host name.
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(host)
        if name is None or not (is_loopback(name) or name in self.allowed_hosts):
            detail = (
                "Host must be a loopback name such as 127.0.0.1, or one of "
                f"STICKSLIP_ALLOWED_HOSTS; got {host[:100]!r}"
            )
            return ProblemError(403, ProblemCode.host_not_allowed, detail)
        # Programs send no Origin. Reading harms nothing, since other sites cannot see the answer.
        origin = headers.get("origin")
        if origin is None or scope["method"] in _SAFE_METHODS:
            return None
        if urlsplit(origin).netloc.lower() == host.lower():
            return None
        detail = (
            f"Origin must be that of the coordinator's own pages, http://{host[:100]}; "
            f"got {origin[:100]!r}"
        )
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
        self._open_scopes = frozenset[Scope]() if required else frozenset(Scope) - {Scope.work}

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        needed = needed_scope(scope["method"], scope["path"]) if scope["type"] == "http" else None
        if needed is None:
            await self._app(scope, receive, send)
            return
        try:
            principal = await self._authorise(Headers(scope=scope), needed)
        except OperationalError:
            detail = "the coordinator cannot read its keys; its log says more"
            retry = {"Retry-After": "10"}
            principal = ProblemError(503, ProblemCode.storage_error, detail, headers=retry)
        if isinstance(principal, ProblemError):
            await principal.answer(scope, receive, send)
            return
        with acting_as(principal):
            await self._app(scope, receive, send)

    async def _authorise(self, headers: Headers, needed: Scope) -> Principal | ProblemError:
        """Return the principal of a request, or the reason to refuse it."""
        authorization = headers.get("authorization")
        if authorization is None:
            if needed in self._open_scopes:
                return Principal(scopes=self._open_scopes)
            return _unauthorized(f"the request needs a key of the scope `{needed}`")
        try:
            principal = await self._principal_of(authorization)
        except InvalidKeyError as error:
            return _unauthorized(str(error))
        if needed in self._open_scopes or principal.may(needed):
            return principal
        granted = ", ".join(scope for scope in Scope if scope in principal.scopes)
        detail = f"the request needs the scope `{needed}`, and the key has: {granted}"
        return ProblemError(403, ProblemCode.scope_missing, detail)

    async def _principal_of(self, authorization: str) -> Principal:
        """Return the holder of the key in a header; raise InvalidKeyError."""
        secret = _secret(authorization)
        if secret is None:
            raise InvalidKeyError("the header Authorization has no key")
        if self._ring.is_fresh:
            return self._ring.holder_of(secret)
        # The ring reads the database, which must not block the event loop.
        return await run_in_threadpool(self._ring.holder_of, secret)


def _unauthorized(reason: str) -> ProblemError:
    headers = {"WWW-Authenticate": _CHALLENGE}
    return ProblemError(401, ProblemCode.unauthorized, f"{reason}{_KEY_HELP}", headers=headers)


def needed_scope(method: str, path: str) -> Scope | None:
    """Return the scope that a request needs; None if it needs no key."""
    # Probes and the scripts of the pages tell nothing.
    if path in ("/livez", "/readyz") or path.startswith(STATIC_PATH):
        return None
    if path.startswith("/v1/worker") and method not in _SAFE_METHODS:
        return Scope.work
    if method in _SAFE_METHODS or path == "/v1/jobs:validate":
        return Scope.read
    if path.startswith("/v1/certificates"):
        return Scope.admin
    return Scope.submit


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
        _, _, password = b64decode(value.strip(), validate=True).decode().partition(":")
    except ValueError:
        return None
    return password or None
