"""Addresses of a coordinator, and the API key of the environment."""

import os
from functools import lru_cache
from ipaddress import ip_address
from urllib.parse import urlsplit

DEFAULT_PORT = 8765
DEFAULT_URL = f"http://127.0.0.1:{DEFAULT_PORT}"

URL_VARIABLE = "STICKSLIP_URL"
"""Environment variable with the URL of the coordinator; without it, `DEFAULT_URL`."""

API_KEY_VARIABLE = "STICKSLIP_API_KEY"
"""Environment variable with the API key of the coordinator that `URL_VARIABLE` names."""

_DEFAULT_PORTS = {"http": 80, "https": 443}


class InvalidKeyError(ValueError):
    """An API key holds a character that no HTTP header may have. The message never has the key."""


@lru_cache
def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach `host`."""
    if host == "localhost":
        return True
    # Names are not resolved: their address may change between the check and the request.
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def coordinator_url() -> str:
    """Return the URL of the coordinator of the environment, by default that of this machine."""
    return os.environ.get(URL_VARIABLE) or DEFAULT_URL


def api_key_of_environment() -> str | None:
    """Return the API key of the environment; None if the variable is unset or empty."""
    return os.environ.get(API_KEY_VARIABLE, "").strip() or None


def api_key_for(url: str) -> str | None:
    """Return the API key of the environment if the coordinator that it belongs to serves `url`.

    The key is a secret of one coordinator: another server would learn it from the request.
    """
    return api_key_of_environment() if is_below(url, coordinator_url()) else None


def check_url(url: str) -> None:
    """Check that a URL names a server.

    Raises:
        ValueError: It does not; the message does not repeat the URL, which may have a password.
    """
    if not url.startswith(("http://", "https://")):
        raise ValueError("must begin with http:// or https://")
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise ValueError("must have a host and a port from 1 to 65535, as in HOST:PORT") from None
    if not parts.hostname or port == 0 or any(character.isspace() for character in url):
        raise ValueError("must have a host, as in http://HOST:PORT, and no spaces")


def is_below(url: str, root: str) -> bool:
    """Return whether `url` is `root` or a path below it, on the same server."""
    # The port belongs to the server: another program may listen on another one.
    if _server(url) != _server(root):
        return False
    # With a slash at the end, `/lab` is no beginning of `/laboratory`.
    root_path = urlsplit(root).path.rstrip("/")
    return f"{urlsplit(url).path}/".startswith(f"{root_path}/")


def _server(url: str) -> tuple[str, str | None, int | None]:
    """Return scheme, host and port of a URL; a URL without them belongs to no server."""
    parts = urlsplit(url)
    port = parts.port or _DEFAULT_PORTS.get(parts.scheme)
    return parts.scheme, parts.hostname, port


def without_password(url: str) -> str:
    """Return a URL for messages, without its user name and password."""
    parts = urlsplit(url)
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


def authorization(api_key: str | None) -> dict[str, str]:
    """Return the header that an API key makes; without a key, no header.

    Raises:
        InvalidKeyError: The key has a space, a line break or a letter outside ASCII.
    """
    if not api_key:
        return {}
    # httpx would refuse such a header with a message that has the key in it.
    is_header_value = api_key.isascii() and api_key.isprintable() and " " not in api_key
    if not is_header_value:
        raise InvalidKeyError(
            "the API key has a space, a line break or a letter outside ASCII: copy it again as "
            f"`stickslip keys create` printed it (the variable is {API_KEY_VARIABLE})"
        )
    return {"Authorization": f"Bearer {api_key}"}
