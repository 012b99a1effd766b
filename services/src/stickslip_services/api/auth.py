"""Authentication and authorisation of requests: `Host`, `Origin` and API key.

A page of another site that is open in a browser on this machine can send requests to the coordinator, but it cannot
forge `Host` and `Origin`. The check of `Host` prevents DNS rebinding, that of `Origin` cross-site request forgery.
"""

from base64 import b64decode
from urllib.parse import urlsplit

from sqlalchemy.exc import OperationalError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as HttpScope
from stickslip_schemas.documents.problems import ProblemCode

from stickslip_services.access.asker import Asker, Scope, asking
from stickslip_services.access.keys import KeyRing
from stickslip_services.addresses import is_loopback
from stickslip_services.api.problems import ProblemError

_SAFE = ("GET", "HEAD", "OPTIONS")

_CHALLENGE = 'Bearer realm="stickslip", Basic realm="stickslip: a key as password"'
_HOW = (
    ", as `Authorization: Bearer KEY` or as the password of Basic; `stickslip keys create` makes keys, and local "
    "workers use the one in the file `worker-key` of the data directory"
)


class OriginMiddleware:
    """Refuses requests for a foreign host name, and changes requested by pages of other sites."""

    def __init__(self, app: ASGIApp, allowed_hosts: tuple[str, ...] = ()) -> None:
        self._app = app
        self._allowed_hosts = allowed_hosts

    async def __call__(self, scope: HttpScope, receive: Receive, send: Send) -> None:
        refusal = self._refusal(scope) if scope["type"] == "http" else None
        await (self._app if refusal is None else refusal.answer)(scope, receive, send)

    def _refusal(self, scope: HttpScope) -> ProblemError | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(host)
        if name is None or not (is_loopback(name) or name in self._allowed_hosts):
            detail = (
                f"Host must be a loopback name such as 127.0.0.1, or one of STICKSLIP_ALLOWED_HOSTS; got {host[:100]!r}"
            )
            return ProblemError(403, ProblemCode.host_not_allowed, detail)
        origin = headers.get("origin")
        if origin is None or scope["method"] in _SAFE or urlsplit(origin).netloc.lower() == host.lower():
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

    The scope follows from method and path alone, so that a new route is never open by mistake. Where no key is
    required, everybody on this machine may do everything except act as a worker.
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
            admitted = ProblemError(503, ProblemCode.storage_error, detail, headers={"Retry-After": "10"})
        if isinstance(admitted, ProblemError):
            await admitted.answer(scope, receive, send)
            return
        with asking(admitted):
            await self._app(scope, receive, send)

    async def _admitted(self, headers: Headers, needed: Scope) -> Asker | ProblemError:
        """Return the holder of the request's key, or why the request is refused."""
        authorization = headers.get("authorization")
        if authorization is None:
            if needed in self._open:
                return Asker(scopes=self._open)
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
    return ProblemError(401, ProblemCode.unauthorized, f"{why}{_HOW}", headers={"WWW-Authenticate": _CHALLENGE})


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
    """Return the secret of an Authorization header; browsers send it as the password of a user of any name."""
    scheme, _, value = authorization.partition(" ")
    if scheme.lower() == "bearer":
        return value.strip() or None
    if scheme.lower() != "basic":
        return None
    try:
        return b64decode(value.strip(), validate=True).decode().partition(":")[2] or None
    except ValueError:
        return None
