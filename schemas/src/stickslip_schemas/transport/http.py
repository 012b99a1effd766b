"""One HTTP client for coordinators and for servers of datasets.

It asks the proxy of the environment or the server itself (see `proxies`), repeats requests while a
server restarts, and reads no more of an answer than the caller allows. It asks for bodies as they
are and refuses compressed ones, so a small answer cannot unpack to gigabytes.
"""

import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain, repeat
from typing import TypedDict, Unpack

import httpx

from stickslip_schemas.transport.addresses import authorization, without_password
from stickslip_schemas.transport.limits import DOCUMENT_BYTES, DOCUMENT_SECONDS
from stickslip_schemas.transport.proxies import Proxy, proxy_for

CONNECT_SECONDS = 5.0
"""How long a connection may take to be made [s]."""
TIMEOUT_SECONDS = 60.0
"""How long a server may send nothing [s]."""
RETRY_SECONDS = 60.0
"""How long a failed request is repeated [s]."""
PAUSES_SECONDS = (0.25, 0.5, 1.0, 2.0, 3.0)
"""Longest pauses between attempts [s], the last one repeated; a random fraction is waited."""
BUSY_STATUS = 503
_GATEWAY_STATUSES = frozenset({502, 504})
"""A proxy or a load balancer does not reach the server, which may be restarting."""


class RequestOptions(TypedDict, total=False):
    """Options of a request, as httpx has them."""

    json: object
    content: bytes
    headers: Mapping[str, str]
    params: Mapping[str, str]


class TransportError(Exception):
    """The server does not answer; the message names it, the proxy and the cause."""


class AnswerError(Exception):
    """The body of an answer is larger than allowed, or compressed though nobody asked for that."""

    def __init__(self, response: httpx.Response, fault: str) -> None:
        super().__init__(f"{without_password(str(response.url))} {fault}")
        self.status = response.status_code


class _RoutingTransport(httpx.BaseTransport):
    """Sends each request directly, or through the proxy that the environment names for its host."""

    def __init__(self) -> None:
        self._routes: dict[tuple[Proxy | None, bool], httpx.HTTPTransport] = {}
        # Threads that download share the transports, and their connections stay open.
        self._lock = threading.Lock()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        proxy = proxy_for(str(request.url))
        try:
            return self._route(proxy, request.url.scheme).handle_request(request)
        except httpx.TransportError as error:
            if proxy is None:
                raise
            cause = str(error) or type(error).__name__
            raise type(error)(f"{cause}, through {proxy}") from error

    def close(self) -> None:
        for transport in self._routes.values():
            transport.close()

    def _route(self, proxy: Proxy | None, scheme: str) -> httpx.HTTPTransport:
        needs_tls = scheme == "https" or (proxy is not None and proxy.url.startswith("https"))
        key = (proxy, needs_tls)
        with self._lock:
            if key not in self._routes:
                self._routes[key] = _transport(proxy, needs_tls=needs_tls)
            return self._routes[key]


def _transport(proxy: Proxy | None, *, needs_tls: bool) -> httpx.HTTPTransport:
    # Loading the authorities takes 20 CPU ms, which plain HTTP does not need. SSL_CERT_FILE names
    # others: only this machine may trust the authority of the coordinator's certificate.
    verify = httpx.create_ssl_context() if needs_tls else False
    try:
        return httpx.HTTPTransport(verify=verify, proxy=proxy.url if proxy else None)
    except (ValueError, ImportError) as error:  # httpx asks for a package for SOCKS
        raise httpx.ProxyError("only http:// and https:// proxies can be used") from error


class HttpClient:
    """A client of one server; threads may share it."""

    def __init__(
        self,
        base_url: str = "",
        *,
        api_key: str | None = None,
        retry_timeout: float = RETRY_SECONDS,
        follow_redirects: bool = False,
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Make a client; nothing is asked yet.

        Args:
            base_url: URL before the paths of requests.
            api_key: Key that is sent to the server; it does not follow redirects to others.
            retry_timeout: How long a failed request is repeated [s].
            follow_redirects: Whether an answer may lead to another URL.
            transport: Transport of httpx, for tests.
            sleep: Waits between attempts, for tests.

        Raises:
            InvalidKeyError: The key cannot be sent.
        """
        self.retry_timeout = retry_timeout
        self._sleep = sleep
        self._was_answered = False
        self._http = httpx.Client(
            base_url=base_url,
            timeout=httpx.Timeout(TIMEOUT_SECONDS, connect=CONNECT_SECONDS),
            headers={"Accept-Encoding": "identity", **authorization(api_key)},
            follow_redirects=follow_redirects,
            transport=transport or _RoutingTransport(),
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def request(
        self,
        method: str,
        url: str,
        *,
        limit: int = DOCUMENT_BYTES,
        **options: Unpack[RequestOptions],
    ) -> httpx.Response:
        """Send a request, and repeat it while the connection fails or the server is busy.

        A server that has never answered is not waited for: its URL may be wrong. One that has may
        be restarting.

        Args:
            method: `GET` for example.
            url: URL, or path below the base URL.
            limit: Largest body that is accepted [bytes].
            options: Query, headers and body.

        Returns:
            The answer, of whatever status, with its body.

        Raises:
            TransportError: The server does not answer.
            AnswerError: The body is larger than `limit`, or compressed.
        """
        until = time.monotonic() + self.retry_timeout
        for pause in chain(PAUSES_SECONDS, repeat(PAUSES_SECONDS[-1])):
            is_last = time.monotonic() >= until
            # Requests that change something are idempotent, so every one may be repeated.
            try:
                response = self._attempt(method, url, limit, options)
            except httpx.InvalidURL as error:
                raise TransportError(f"is not a URL: {error}") from error
            except httpx.TooManyRedirects as error:
                raise TransportError("sends from one URL to another without an end") from error
            except httpx.TransportError as error:
                is_absent = isinstance(error, httpx.ConnectError | httpx.ProxyError)
                if is_last or (is_absent and not self._was_answered):
                    raise TransportError(f"does not answer: {describe(error)}") from error
            else:
                is_absent = response.status_code in _GATEWAY_STATUSES
                # 503 is the coordinator's own word; the others are those of a proxy before it.
                is_busy = response.status_code == BUSY_STATUS or (is_absent and self._was_answered)
                self._was_answered = self._was_answered or not is_absent
                if is_last or not is_busy:
                    return response
            self._sleep(pause * random.random())
        raise AssertionError("the pauses never end")

    def _attempt(
        self, method: str, url: str, limit: int, options: RequestOptions
    ) -> httpx.Response:
        with self._http.stream(method, url, **options) as response:
            body = read_bounded(response, limit)
            return httpx.Response(
                response.status_code,
                headers=response.headers,
                content=body,
                request=response.request,
            )

    @contextmanager
    def stream(
        self,
        method: str,
        url: str,
        *,
        silence: float = TIMEOUT_SECONDS,
        **options: Unpack[RequestOptions],
    ) -> Iterator[httpx.Response]:
        """Open an answer whose body the caller reads, with `iter_raw` and within limits of its own.

        Args:
            method: `GET` for example.
            url: URL, or path below the base URL.
            silence: How long the server may send nothing [s].
            options: Query, headers and body.

        Raises:
            TransportError: The connection failed, before or while the body was read.
            AnswerError: The body is compressed.
        """
        timeout = httpx.Timeout(silence, connect=CONNECT_SECONDS)
        try:
            with self._http.stream(method, url, timeout=timeout, **options) as response:
                _refuse_compression(response)
                yield response
        except httpx.TransportError as error:
            raise TransportError(f"does not answer: {describe(error)}") from error


def describe(error: httpx.TransportError) -> str:
    """Return the cause of a failed connection in words; some errors of httpx have none."""
    return str(error) or type(error).__name__


def read_bounded(response: httpx.Response, limit: int) -> bytes:
    """Return the body of an answer that is open.

    Raises:
        AnswerError: The body is compressed, larger than `limit` bytes, or does not end in time.
    """
    _refuse_compression(response)
    # A size that is stated spares the reading; one that is not, or a wrong one, is counted.
    stated = response.headers.get("content-length", "")
    if stated.isdecimal() and int(stated) > limit:
        raise AnswerError(response, f"has {stated} bytes, and at most {limit} are accepted")
    until = time.monotonic() + DOCUMENT_SECONDS
    body = bytearray()
    # A transport of a test may have read the body already.
    blocks = [response.content] if response.is_stream_consumed else response.iter_raw()
    for block in blocks:
        body += block
        if len(body) > limit:
            raise AnswerError(response, f"sends more than the {limit} bytes that are accepted")
        if time.monotonic() > until:
            raise AnswerError(response, f"does not end within {DOCUMENT_SECONDS:.0f} s")
    return bytes(body)


def _refuse_compression(response: httpx.Response) -> None:
    encoding = response.headers.get("content-encoding", "identity")
    if encoding.strip().lower() not in ("", "identity"):
        raise AnswerError(
            response, "answered with a compressed body, though it was asked for a plain one"
        )
