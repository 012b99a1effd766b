"""One rule for proxies and keys, and answers that are read up to a limit."""

import gzip
import http.server
import threading
from collections.abc import Iterator

import httpx
import pytest
from stickslip_schemas.transport import http as transport
from stickslip_schemas.transport.addresses import (
    InvalidKeyError,
    api_key_for,
    api_key_of_environment,
    authorization,
    check_url,
    is_below,
    without_password,
)
from stickslip_schemas.transport.http import AnswerError, HttpClient, TransportError
from stickslip_schemas.transport.proxies import object_store_options, proxy_for

VARIABLES = ("http_proxy", "https_proxy", "all_proxy", "no_proxy")
REMOTE = "http://stick.example.org/v1"


@pytest.fixture(autouse=True)
def _no_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        for variable in (name, name.upper()):
            monkeypatch.delenv(variable, raising=False)


class ForwardProxy(http.server.ThreadingHTTPServer):
    daemon_threads = True
    targets: list[str]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(http.server.BaseHTTPRequestHandler):
    """Answers for every host, as a proxy does, and for its own."""

    server: ForwardProxy

    def do_GET(self) -> None:
        self.server.targets.append(self.path)
        self.send_response(200)
        self.send_header("Content-Length", "2")
        self.end_headers()
        self.wfile.write(b"ok")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def proxy() -> Iterator[ForwardProxy]:
    server = ForwardProxy(("127.0.0.1", 0), Handler)
    server.targets = []
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def get(url: str) -> bytes:
    client = HttpClient(retry_timeout=0.0)
    try:
        return client.request("GET", url).content
    finally:
        client.close()


@pytest.mark.parametrize("variable", ["http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"])
def test_another_machine_is_asked_through_the_proxy(
    proxy: ForwardProxy, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    monkeypatch.setenv(variable, proxy.url)
    assert get(REMOTE) == b"ok"
    assert proxy.targets == [REMOTE]


def test_this_machine_is_asked_directly(
    proxy: ForwardProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in VARIABLES[:3]:
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    assert get(f"{proxy.url}/direct") == b"ok"
    assert proxy.targets == ["/direct"]


@pytest.mark.parametrize(
    ("environment", "url", "expected"),
    [
        ({"http_proxy": "http://p:1"}, REMOTE, "http://p:1"),
        ({"http_proxy": "p:1"}, REMOTE, "http://p:1"),
        ({"http_proxy": "http://p:1"}, "https://stick.example.org", None),
        ({"https_proxy": "http://p:1"}, "https://stick.example.org", "http://p:1"),
        ({"http_proxy": "http://low:1", "HTTP_PROXY": "http://up:1"}, REMOTE, "http://low:1"),
        ({"http_proxy": "", "HTTP_PROXY": "http://up:1"}, REMOTE, None),
        ({"http_proxy": "http://p:1", "no_proxy": "example.org"}, REMOTE, None),
        ({"http_proxy": "http://p:1", "NO_PROXY": "*"}, REMOTE, None),
        ({"all_proxy": "http://p:1"}, "http://localhost:8765", None),
        ({"all_proxy": "http://p:1"}, "http://127.8.9.1:8765", None),
        ({"all_proxy": "http://p:1"}, "http://[::1]:8765", None),
    ],
)
def test_the_rule(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], url: str, expected: str | None
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    proxy = proxy_for(url)
    assert (proxy and proxy.url) == expected
    options = object_store_options(url)
    if expected is None:
        assert options["proxy_excludes"] in url
    else:
        assert options == {"proxy_url": expected}


def test_a_message_names_the_proxy_without_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("all_proxy", "http://me:hidden@127.0.0.1:9")
    with pytest.raises(TransportError) as caught:
        get(REMOTE)
    assert str(caught.value).endswith(
        "through the proxy http://127.0.0.1:9 of the variable all_proxy"
    )
    monkeypatch.setenv("all_proxy", "socks5://127.0.0.1:9")
    with pytest.raises(TransportError, match="proxies can be used, through the proxy socks5"):
        get(REMOTE)


def answer_of(path: str) -> httpx.Response:
    if path == "/plain":  # without a stated size
        return httpx.Response(200, content=iter([b"x" * 5, b"x" * 5]))
    if path == "/stated":
        return httpx.Response(200, content=b"x" * 99)
    return httpx.Response(200, headers={"Content-Encoding": "gzip"}, content=gzip.compress(b"x"))


def test_an_answer_is_read_up_to_the_limit() -> None:
    serve = httpx.MockTransport(lambda request: answer_of(request.url.path))
    client = HttpClient("http://127.0.0.1", transport=serve)
    assert client.request("GET", "/plain", limit=10).content == b"x" * 10
    for path, message in (
        ("/plain", "sends more than the 9 bytes"),
        ("/stated", "has 99 bytes, and at most 9"),
        ("/gzip", "compressed"),
    ):
        with pytest.raises(AnswerError, match=message) as caught:
            client.request("GET", path, limit=9)
        assert caught.value.status == 200


def test_a_document_must_end_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "DOCUMENT_SECONDS", -1.0)
    answer = httpx.Response(200, content=b"x")
    client = HttpClient("http://127.0.0.1", transport=httpx.MockTransport(lambda _: answer))
    with pytest.raises(AnswerError, match="does not end within"):
        client.request("GET", "/")


@pytest.mark.parametrize(
    ("answers", "pauses"),
    [
        ([503, 503, 200], 2),
        ([200], 0),
        ([502], 0),  # it has never answered: its URL may be wrong
        ([503, 502, 504, 200], 3),  # it restarts behind a proxy
        ([429], 0),  # a quota does not pass by waiting
    ],
)
def test_a_busy_server_is_asked_again(answers: list[int], pauses: int) -> None:
    statuses = iter(answers)
    slept: list[float] = []
    client = HttpClient(
        "http://127.0.0.1",
        transport=httpx.MockTransport(lambda _: httpx.Response(next(statuses))),
        sleep=slept.append,
    )
    assert client.request("GET", "/").status_code == answers[-1]
    assert len(slept) == pauses


@pytest.mark.parametrize(
    ("url", "root", "expected"),
    [
        ("http://a/lab/v1", "http://a/lab", True),
        ("http://a:80/lab", "http://A/lab/", True),
        ("http://a/laboratory", "http://a/lab", False),
        ("https://a/lab", "http://a/lab", False),
        ("http://a:81/lab", "http://a/lab", False),
        ("http://b/lab", "http://a/lab", False),
        ("http://a@b/", "http://a/", False),
    ],
)
def test_the_urls_of_a_coordinator(url: str, root: str, expected: bool) -> None:
    assert is_below(url, root) is expected


def test_the_key_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STICKSLIP_API_KEY", " sk_1\n")
    monkeypatch.delenv("STICKSLIP_URL", raising=False)
    assert api_key_for("http://127.0.0.1:8765/v1/datasets") == "sk_1"
    assert api_key_for("http://127.0.0.1:8766/v1/datasets") is None
    monkeypatch.setenv("STICKSLIP_URL", "https://stick.example.org/lab")
    assert api_key_for("https://stick.example.org/lab/v1") == "sk_1"
    assert api_key_for("https://stick.example.org/v1") is None
    for value in ("", " ", "\n"):
        monkeypatch.setenv("STICKSLIP_API_KEY", value)
        assert api_key_of_environment() is None


@pytest.mark.parametrize("key", ["a b", "a\nb", "schlüssel", "a\x1b"])
def test_a_key_that_cannot_be_sent_is_not_repeated(key: str) -> None:
    with pytest.raises(InvalidKeyError) as caught:
        authorization(key)
    assert key not in str(caught.value)
    assert authorization("") == authorization(None) == {}


@pytest.mark.parametrize(
    "url", ["ftp://x", "x", "http://", "http://a:b", "http://[::1", "http://a b"]
)
def test_a_url_that_names_no_server(url: str) -> None:
    with pytest.raises(ValueError, match="must"):
        check_url(url)
    assert without_password("http://me:hidden@a/b") == "http://a/b"
