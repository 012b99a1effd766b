"""A real S3 server in a process, and a proxy with the faults of networks and clouds."""

import http.client
import os
import random
import socket
import socketserver
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler

_START_SECONDS = 60.0

Fault = Callable[[str, str], str]
"""Says what is to happen to a request, by its method and its path: "" for nothing, or a key of
`Proxy.faults`.
"""


def no_fault(method: str, path: str) -> str:
    """Let everything pass."""
    return ""


@dataclass
class Proxy:
    """Passes requests on to a server, one connection each."""

    server: int
    port: int = 0
    fault: Fault = no_fault
    counts: Counter[str] = field(default_factory=Counter)
    """How many requests there were, by method, and faults, by name."""
    one_by_one: threading.Lock = field(default_factory=threading.Lock)
    """Held while the server answers a conditional request."""

    def inject_faults(self, seed: int, shares: dict[str, float]) -> None:
        """Let faults happen at random, each to its share of the requests."""
        dice, lock = random.Random(seed), threading.Lock()

        def fault(method: str, path: str) -> str:
            with lock:
                return dice.choices([*shares, ""], [*shares.values(), 1 - sum(shares.values())])[0]

        self.fault = fault


class _Handler(BaseHTTPRequestHandler):
    """Passes requests on, with the faults of its proxy."""

    proxy: Proxy
    protocol_version = "HTTP/1.1"

    def do(self) -> None:
        self.proxy.counts[self.command] += 1
        fault = self.proxy.fault(self.command, self.path)
        self.proxy.counts[fault] += 1
        size = int(self.headers.get("Content-Length", 0))
        if (
            fault == "torn upload"
        ):  # part of the body arrives, then the line is cut, to the server too
            self._pass_on(self.rfile.read(size // 2), size)
            return self._hang_up()
        body = self.rfile.read(size)
        if fault == "late":
            time.sleep(0.3)
        if fault in ("503", "409", "500", "501"):
            return self._answer(
                int(fault),
                {"Content-Type": "application/xml"},
                f"<Error>{fault}</Error>".encode(),
            )
        # S3 looks and writes at once; moto does one after the other, and lets two writers of
        # one object win.
        conditional = self.command == "PUT" and "If-None-Match" in self.headers
        with self.proxy.one_by_one if conditional else nullcontext():
            status, headers, answer = self._ask(body)
        if fault == "lost answer":  # done, but nobody hears of it
            return self._hang_up()
        if fault == "torn download":
            self._answer(status, headers, answer, stop=len(answer) // 2)
            return self._hang_up()
        return self._answer(status, headers, answer)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = do  # noqa: N815

    def _ask(self, body: bytes) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.proxy.server, timeout=60)
        connection.request(self.command, self.path, body, dict(self.headers.items()))
        response = connection.getresponse()
        answer = response.read()
        connection.close()
        return response.status, dict(response.getheaders()), answer

    def _pass_on(self, part: bytes, size: int) -> None:
        with suppress(OSError), socket.create_connection(("127.0.0.1", self.proxy.server)) as line:
            head = "".join(f"{name}: {value}\r\n" for name, value in self.headers.items())
            line.sendall(f"{self.command} {self.path} HTTP/1.1\r\n{head}\r\n".encode() + part)

    def _answer(
        self, status: int, headers: dict[str, str], body: bytes, *, stop: int | None = None
    ) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            if name.lower() not in ("connection", "transfer-encoding", "content-length"):
                self.send_header(name, value)
        length = headers.get("Content-Length") if self.command == "HEAD" else None
        self.send_header("Content-Length", length or str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body[:stop])

    def _hang_up(self) -> None:
        self.close_connection = True
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass


def _handler(proxy: Proxy) -> type[BaseHTTPRequestHandler]:
    """Return a handler of the requests of a proxy."""
    return type("Handler", (_Handler,), {"proxy": proxy})


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    request_queue_size = 64

    def handle_error(self, request: object, client_address: object) -> None:
        pass  # a client that hung up


@contextmanager
def s3_proxy() -> Iterator[Proxy]:
    """Run moto's S3 server and a proxy in front of it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-m",
        "moto.server",
        "-H",
        "127.0.0.1",
        "-p",
        str(port),
    ]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        try:
            _wait(port, process)
            proxy = Proxy(port)
            with _Server(("127.0.0.1", 0), _handler(proxy)) as server:
                proxy.port = server.server_address[1]
                threading.Thread(target=server.serve_forever, daemon=True).start()
                yield proxy
                server.shutdown()
        finally:
            process.kill()


def _wait(port: int, process: "subprocess.Popen[bytes]") -> None:
    end = time.monotonic() + _START_SECONDS
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return
        except OSError as error:
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(
                    f"moto's server did not start; status {process.poll()}"
                ) from error
        time.sleep(0.05)


def variables(proxy: Proxy) -> dict[str, str]:
    """Return the environment of a process that is to use a server through its proxy."""
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{proxy.port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
    }


def make_bucket(proxy: Proxy, name: str) -> None:
    """Make a bucket on the server itself."""
    connection = http.client.HTTPConnection("127.0.0.1", proxy.server, timeout=60)
    connection.request("PUT", f"/{name}")
    assert connection.getresponse().status == 200
    connection.close()
