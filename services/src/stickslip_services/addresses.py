"""The address by which a request has reached the coordinator, and addresses that begin with it.

A proxy may offer the coordinator below a path, such as `https://lab.example/stickslip/`. Then all
links need that path in front of them. Proxies either pass it on or strip it, and both work.
"""

import re
from contextvars import ContextVar
from typing import NamedTuple

MAX_PREFIX = 200
"""Longest path in front of the coordinator's own [characters]."""

_PREFIX = re.compile(r"(/[A-Za-z0-9_~-][A-Za-z0-9._~-]*)+")

OWN_WORDS = (
    *("v1", "ui", "static", "jobs", "datasets", "scenes", "certificates", "workers", "submit"),
    *("docs", "openapi.json", "livez", "readyz", "metrics"),
)
"""First words of the coordinator's own paths, with which no prefix may begin."""


class Address(NamedTuple):
    """How a client addresses the coordinator."""

    origin: str
    """Scheme, host and port, for example `https://lab.example`."""
    prefix: str
    """Path in front of the coordinator's own, for example `/stickslip`; mostly empty."""


_NOWHERE = Address("", "")
_reached = ContextVar("reached", default=_NOWHERE)


def enter(address: Address) -> None:
    """Note how the client of the request that this task answers addresses the coordinator."""
    # It is not taken back: each request is answered in a task of its own, and the answer to an
    # unexpected error is made after all middleware has ended.
    _reached.set(address)


def link(path: str) -> str:
    """Return a path of the coordinator as the client of this request must write it."""
    return _reached.get().prefix + path


def prefix() -> str:
    """Return the path in front of the coordinator's own paths; mostly empty."""
    return _reached.get().prefix


def url() -> str:
    """Return the URL of the coordinator as the client of this request knows it."""
    return "".join(_reached.get())


def checked_prefix(text: str) -> str:
    """Return a prefix without a slash at its end; raise ValueError for any other text."""
    bare = text.rstrip("/")
    if not bare:
        return ""
    if len(bare) > MAX_PREFIX or _PREFIX.fullmatch(bare) is None:
        raise ValueError(
            "must be a path such as /stickslip: words of letters, digits and . _ ~ -, each after "
            f"a slash, and at most {MAX_PREFIX} characters; it is {text[:MAX_PREFIX]!r}"
        )
    first = bare.split("/")[1]
    if first in OWN_WORDS:
        raise ValueError(
            f"must not begin with /{first}, because paths of the coordinator begin so; it is "
            f"{text!r}. Take another word"
        )
    return bare


def without_prefix(path: str, prefix: str) -> str:
    """Return a path of a request without the prefix, which a proxy may have stripped before."""
    if prefix and (path == prefix or path.startswith(f"{prefix}/")):
        return path[len(prefix) :] or "/"
    return path
