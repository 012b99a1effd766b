"""Who may come in: the name the coordinator is asked by, the page that asks, and the key of the workers.

A page of another site that is open in a browser on this machine can send requests here too. It cannot forge `Host` and
`Origin`, so both are checked: the one against DNS rebinding, the other against forged forms.
"""

import hmac
import secrets
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import Request
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send
from stickslip_schemas.problems import ProblemCode
from stickslip_schemas.store import write_durably

from stickslip_services.addresses import is_loopback
from stickslip_services.api.problems import ProblemError, problem_response

_SAFE = ("GET", "HEAD", "OPTIONS")


class DoorMiddleware:
    """Refuses requests under a foreign name, and changes that a page of another site asks for."""

    def __init__(self, app: ASGIApp, allowed_hosts: tuple[str, ...] = ()) -> None:
        self._app = app
        self._allowed_hosts = allowed_hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        refusal = self._refusal(scope) if scope["type"] == "http" else None
        if refusal is None:
            await self._app(scope, receive, send)
            return
        request_id = scope.get("state", {}).get("request_id")
        response = problem_response(403, *refusal, path=scope["path"], request_id=request_id)
        await response(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[ProblemCode, str] | None:
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


def worker_key(path: Path) -> str:
    """Return the key of the workers; make it where there is none. Only its owner can read the file."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, f"{secrets.token_urlsafe(32)}\n".encode(), mode=0o600)
    return path.read_text(encoding="ascii").strip()


def require_worker_key(request: Request) -> None:
    """Raise ProblemError where a request does not carry the key of the workers."""
    scheme, _, key = request.headers.get("authorization", "").partition(" ")
    expected: str = request.app.state.worker_key
    if scheme.lower() != "bearer" or not hmac.compare_digest(key.strip().encode(), expected.encode()):
        raise ProblemError(
            401,
            ProblemCode.unauthorized,
            "the worker API needs the key in the file `worker-key` of the data directory, as `Authorization: Bearer`",
            headers={"WWW-Authenticate": 'Bearer realm="stickslip workers"'},
        )
