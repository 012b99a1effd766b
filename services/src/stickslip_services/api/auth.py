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

from stickslip_services.access.asker import Asker, asking
from stickslip_services.access.keys import KeyRing
from stickslip_services.access.scopes import Scope
from stickslip_services.addresses import is_loopback
from stickslip_services.api.problems import problem_response

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
        """Handle a request."""
        refusal = self._refusal(scope) if scope["type"] == "http" else None
        if refusal is None:
            await self._app(scope, receive, send)
            return
        request_id = scope.get("state", {}).get("request_id")
        response = problem_response(403, *refusal, path=scope["path"], request_id=request_id)
        await response(scope, receive, send)

    def _refusal(self, scope: HttpScope) -> tuple[ProblemCode, str] | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        name = _host_name(host)
        if name is None or not (is_loopback(name) or name in self._allowed_hosts):
            return ProblemCode.host_not_allowed, (
                f"Host must be a loopback name such as 127.0.0.1, or one of STICKSLIP_ALLOWED_HOSTS; got {host[:100]!r}"
            )
        origin = headers.get("origin")
        if origin is None or scope["method"] in _SAFE or urlsplit(origin).netloc.lower() == host.lower():
            return None
        return ProblemCode.origin_not_allowed, (
            f"Origin must be that of the coordinator's own pages, http://{host[:100]}; got {origin[:100]!r}"
        )


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
        """Handle a request."""
        needed = needed_scope(scope["method"], scope["path"]) if scope["type"] == "http" else None
        if needed is None:
            await self._app(scope, receive, send)
            return
        try:
            admitted = await self._admitted(Headers(scope=scope), needed)
        except OperationalError:
            admitted = (503, ProblemCode.storage_error, "the coordinator cannot read its keys; its log says more")
        if isinstance(admitted, Asker):
            with asking(admitted):
                await self._app(scope, receive, send)
            return
        status, code, detail = admitted
        request_id = scope.get("state", {}).get("request_id")
        headers = {"WWW-Authenticate": _CHALLENGE} if status == 401 else {"Retry-After": "10"} if status == 503 else {}
        response = problem_response(status, code, detail, path=scope["path"], request_id=request_id, headers=headers)
        await response(scope, receive, send)

    async def _admitted(self, headers: Headers, needed: Scope) -> Asker | tuple[int, ProblemCode, str]:
        """Return the holder of the request's key, or why the request is refused (status, code, detail)."""
        authorization = headers.get("authorization")
        if authorization is None:
            if needed in self._open:
                return Asker(scopes=self._open)
            return 401, ProblemCode.unauthorized, f"the request needs a key of the scope `{needed}`{_HOW}"
        secret = _secret(authorization)
        if secret is None or self._ring.is_fresh:
            holder = None if secret is None else self._ring.holder_of(secret)
        else:
            holder = await run_in_threadpool(self._ring.holder_of, secret)
        if holder is None:
            return 401, ProblemCode.unauthorized, f"the key is not known, or it was revoked{_HOW}"
        if needed in self._open or holder.may(needed):
            return holder
        has = ", ".join(scope for scope in Scope if scope in holder.scopes)
        return 403, ProblemCode.scope_missing, f"the request needs the scope `{needed}`, and the key has: {has}"


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
