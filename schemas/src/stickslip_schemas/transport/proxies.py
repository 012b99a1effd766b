"""The proxy of a request: one rule for all HTTP of clients.

The variables of the environment are honoured for other machines, and never for this one: a proxy
cannot reach the loopback addresses of the machine that asks it.
"""

import os
from typing import NamedTuple
from urllib.parse import urlsplit
from urllib.request import proxy_bypass

from stickslip_schemas.transport.addresses import is_loopback

_UNUSED_PROXY = "http://127.0.0.1:9"
"""Port 9 discards. `object_store` ignores the environment only if it has a proxy of its own."""


class Proxy(NamedTuple):
    """A proxy, and the variable that names it."""

    url: str
    variable: str

    def __str__(self) -> str:
        """Return words for messages, without the user name and password of the proxy."""
        parts = urlsplit(self.url)
        address = parts.netloc.rpartition("@")[2]
        return f"the proxy {parts.scheme}://{address} of the variable {self.variable}"


def proxy_for(url: str) -> Proxy | None:
    """Return the proxy that the environment names for a URL; None if the host is asked directly.

    `NO_PROXY` lists hosts that are asked directly. A variable in lower case comes first, and an
    empty one switches the other off, as curl has it.
    """
    # The loopback rule comes first, whatever NO_PROXY says.
    parts = urlsplit(url)
    host = parts.hostname or ""
    if not host or is_loopback(host) or proxy_bypass(host):
        return None
    for name in (f"{parts.scheme}_proxy", "all_proxy"):
        for variable in (name, name.upper()):
            value = os.environ.get(variable)
            if value is None:
                continue
            if value:
                proxy_url = value if "://" in value else f"http://{value}"
                return Proxy(proxy_url, variable)
            # An empty variable in lower case hides the one in upper case.
            break
    return None


def through(url: str) -> str:
    """Return words on the proxy that answered for a URL, for messages; empty without a proxy."""
    proxy = proxy_for(url)
    return "" if proxy is None else f" (through {proxy})"


def object_store_options(url: str) -> dict[str, str]:
    """Return the options of an `object_store` client that hold to the rule for `url`.

    The Rust crate reads the environment itself, also for loopback. A proxy that is named here
    replaces it, and excluding every host from that proxy leaves none.
    """
    proxy = proxy_for(url)
    if proxy is not None:
        return {"proxy_url": proxy.url}
    host = urlsplit(url).hostname or ""
    return {"proxy_url": _UNUSED_PROXY, "proxy_excludes": host}
