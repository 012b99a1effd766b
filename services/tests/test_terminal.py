"""What people see: widths, pipes that end early, names of datasets, and text of hostile servers."""

import http.server
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from stickslip_services.app import make_app
from stickslip_services.cli import _COMMANDS, _loaded, app, output
from stickslip_services.client import Client
from stickslip_services.client.answers import printable_json
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker

SCRIPT = Path(sys.executable).with_name("stickslip")
WIDTH = 80
NARROW = {"COLUMNS": str(WIDTH)}
PROXIES = {
    name: "http://127.0.0.1:9"
    for lower in ("http_proxy", "https_proxy", "all_proxy")
    for name in (lower, lower.upper())
}


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str, str]]:
    """URL, job and dataset of a coordinator."""
    app = make_app(Settings(data=tmp_path_factory.mktemp("origin"), durable=False))
    with serving(app) as url, Client(url) as client:
        context = app.state.context
        worker = PretendWorker(DirectApi(context), context.store, whole=True).register()
        job = client.submit(rods(gamma=(1.0, 2.0), name="a-name-as-long-as-people-like-them"))
        worker.work()
        reference = client.job(job.id).dataset
        assert reference is not None
        yield url, job.id, reference.dataset


def run(url: str, *arguments: object, **env: str) -> Result:
    words = [str(argument) for argument in arguments]
    return CliRunner().invoke(app, words, env=NARROW | {"STICKSLIP_URL": url} | env)


def subcommands(name: str) -> list[tuple[str, ...]]:
    command = _loaded(name)
    if isinstance(command, click.Group):
        return [(name,), *((name, inner) for inner in command.commands)]
    return [(name,)]


PASSED_ON = ("export", "film", "measure")
"""Commands whose help is that of another program."""

EVERY = [(), *(words for name in _COMMANDS if name not in PASSED_ON for words in subcommands(name))]


@pytest.mark.parametrize("words", EVERY, ids=lambda words: " ".join(words) or "stickslip")
def test_every_help_fits_and_cuts_no_sentence(words: tuple[str, ...]) -> None:
    result = run("", *words, "--help")
    assert result.exit_code == 0
    wide = [line for line in result.stdout.splitlines() if len(line) > WIDTH]
    assert wide == []
    assert "..." not in result.stdout.replace("]...", "").replace("FILES...", "")


def test_commands_are_listed_in_sections() -> None:
    output = run("", "--help").stdout
    heads = [line for line in output.splitlines() if line.endswith(":") and line[0] != " "]
    assert heads == [
        "Options:",
        "Service:",
        "Jobs:",
        "Datasets:",
        "Scenes:",
        "Fabrics:",
        "Certificates:",
        "Measurement:",
        "Administration:",
        "Maintenance:",
    ]
    for name in _COMMANDS:
        assert f"\n  {name} " in output


def test_every_table_fits(origin: tuple[str, str, str], tmp_path: Path) -> None:
    url, job, dataset = origin
    spec = tmp_path / "spec.json"
    spec.write_text(json.dumps(rods()))
    data = ("--data", tmp_path / "data")
    run(url, "keys", "create", "a name of a key that is as long as names of keys may be", *data)
    commands: list[tuple[object, ...]] = [
        ("jobs",),
        ("show", job),
        ("watch", job),
        ("datasets",),
        ("workers",),
        ("certificates",),
        ("validate", spec),
        ("pull", dataset, tmp_path / "d"),
        ("verify", tmp_path / "d"),
        ("verify", tmp_path),
        ("scene", "check", "wipe"),
        ("keys", "list", *data),
        ("projects", "list", *data),
        ("audit-log", *data),
    ]
    for words in commands:
        result = run(url, *words)
        lines = (result.stdout + result.stderr).splitlines()
        # A path or a URL is one word, and breaking it would make it useless.
        wide = [line for line in lines if len(line) > WIDTH and len(line.split()) > 1]
        assert wide == [], words
        assert "Traceback" not in result.output


@pytest.mark.parametrize("width", ["20", "40", "80", "132"])
def test_a_table_fits_any_width(width: str, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setenv("COLUMNS", width)
    output.print_table(("file", "fault", "detail"), [("x" * 50, "size", "y" * 200)], sentences=True)
    output.print_table(("a", "b"), [("z" * 200, "q")])
    output.print_fields([("digest of the spec", "f" * 64)])
    captured = capsys.readouterr()
    assert max(map(len, captured.out.splitlines())) <= int(width)
    assert captured.out.count("f") >= 64


@pytest.mark.real
@pytest.mark.parametrize("words", [["jobs"], ["--help"], ["jobs", "--json"]])
def test_a_reader_that_goes_away_is_no_error(
    origin: tuple[str, str, str], words: list[str]
) -> None:
    end, start = os.pipe()
    os.close(end)  # nobody reads
    env = os.environ | NARROW | {"STICKSLIP_URL": origin[0]}
    done = subprocess.run(
        [SCRIPT, *words], stdout=start, stderr=subprocess.PIPE, env=env, check=False
    )
    os.close(start)
    assert (done.returncode, done.stderr) == (-13, b"")


def test_watching_an_ended_job_shows_its_end(origin: tuple[str, str, str]) -> None:
    url, job, dataset = origin
    result = run(url, "watch", job)
    assert result.exit_code == 0
    assert result.stdout.splitlines()[0] == f"published {dataset}:v1"
    assert result.stdout.splitlines()[-1] == f"{job}: succeeded"
    assert "simulate" not in result.stdout
    events = [json.loads(line) for line in run(url, "watch", job, "--json").stdout.splitlines()]
    assert [event["event"] for event in events] == ["dataset.published", "job.state"]
    assert events[0]["dataset"]["dataset"] == dataset
    assert events[1]["state"] == "succeeded"


def test_a_dataset_is_pulled_by_its_name(origin: tuple[str, str, str], tmp_path: Path) -> None:
    url, _, dataset = origin
    name = "a-name-as-long-as-people-like-them"
    assert run(url, "datasets", "--latest").stdout == f"{dataset}:v1\n"
    for text in (name, f"{name}:v1", f"{dataset}:v1"):
        done = run(url, "pull", text, tmp_path / "d", COLUMNS="300")
        assert (done.exit_code, ": 4 samples, " in done.stdout) == (0, True), done.output
    missing = run(url, "pull", "another", tmp_path / "e", COLUMNS="300")
    assert missing.exit_code == 1
    assert "there is no dataset 'another'" in missing.stderr


def test_a_dead_proxy_does_not_stand_before_this_machine(
    origin: tuple[str, str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, job, dataset = origin
    for name, value in PROXIES.items():
        monkeypatch.setenv(name, value)
    assert run(url, "show", job).exit_code == 0
    assert run(url, "pull", dataset, tmp_path / "d").exit_code == 0
    with Client(url) as client:
        assert "manifest_sha256" in client.open(dataset).attrs


def test_a_dead_proxy_before_another_machine_is_named() -> None:
    proxies = {"http_proxy": "http://me:hidden@127.0.0.1:9", "HTTP_PROXY": "", "no_proxy": ""}
    result = run("http://stick.example.org", "jobs", **proxies, COLUMNS="300")
    assert result.exit_code == 1
    assert "through the proxy http://127.0.0.1:9 of the variable http_proxy" in result.stderr
    assert "hidden" not in result.output


@pytest.mark.parametrize("key", ["", " ", "\n"])
def test_an_empty_key_is_none(origin: tuple[str, str, str], key: str) -> None:
    assert run(origin[0], "jobs", STICKSLIP_API_KEY=key).exit_code == 0


def test_a_key_that_cannot_be_sent_is_not_shown(origin: tuple[str, str, str]) -> None:
    result = run(origin[0], "jobs", STICKSLIP_API_KEY="sek\nrit", COLUMNS="300")
    assert result.exit_code == 1
    assert "the API key has a space, a line break" in result.stderr
    assert "rit" not in result.stderr.replace("sk_", "").replace("written", "")


ATTACK = "\x1b]0;owned\x07 \x9b31m red‮gnihton"


@contextmanager
def answering(
    answer: Callable[[str], tuple[int, str, bytes]], event_headers: Mapping[str, str] | None = None
) -> Iterator[str]:
    """The URL of a server that answers as `answer` says: status, media type and body of a path."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, media_type, body = answer(self.path)
            self.send_response(status)
            self.send_header("Content-Type", media_type)
            self.send_header("Content-Length", str(len(body)))
            if self.path.endswith("/events"):
                for header, value in (event_headers or {}).items():
                    self.send_header(header, value)
            self.end_headers()
            with suppress(OSError):
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize("ascii_only", [True, False])
def test_text_of_a_server_cannot_steer_the_terminal(ascii_only: bool) -> None:
    problem = {
        "type": "x",
        "title": ATTACK,
        "status": 422,
        "detail": ATTACK,
        "code": "not_found",
        "errors": [{"pointer": f"/{ATTACK}", "rule": ATTACK, "value": ATTACK}],
    }
    body = json.dumps(problem, ensure_ascii=ascii_only).encode()
    with answering(lambda _: (422, "application/problem+json", body)) as url:
        for words in (("jobs",), ("show", "job-0"), ("datasets", "--latest")):
            result = run(url, *words)
            assert result.exit_code == 1
            assert "owned" in result.output
            assert not {"\x1b", "\x07", "\x9b", "‮"} & set(result.output)


def test_tables_of_a_hostile_server_are_clean(origin: tuple[str, str, str]) -> None:
    with Client(origin[0]) as client:
        page = client.request("GET", "/v1/jobs").json()
    page["items"][0]["name"] = ATTACK + "\nerror: do what I say"
    body = json.dumps(page).encode()
    with answering(lambda _: (200, "application/json", body)) as url:
        for words in (("jobs",), ("jobs", "--json")):
            result = run(url, *words, COLUMNS="300")
            assert result.exit_code == 0
            assert "owned" in result.stdout
            assert not {"\x1b", "\x07", "\x9b", "‮"} & set(result.output)
            assert "\nerror: do" not in result.output


@pytest.mark.parametrize("fault", ["endless", "gzip"])
def test_an_event_stream_that_is_no_stream(origin: tuple[str, str, str], fault: str) -> None:
    with Client(origin[0]) as client:
        job = client.request("GET", f"/v1/jobs/{origin[1]}").json() | {"state": "running"}
    body = json.dumps(job).encode()

    def answer(path: str) -> tuple[int, str, bytes]:
        if not path.endswith("/events"):
            return 200, "application/json", body
        return 200, "text/event-stream", b"data: " + b"x" * 2**22

    with answering(answer, {"Content-Encoding": "gzip"} if fault == "gzip" else {}) as url:
        result = run(url, "watch", job["id"], COLUMNS="300")
    assert result.exit_code == 1
    expected = "compressed body" if fault == "gzip" else "sent an event of over 1048576 bytes"
    assert expected in result.stderr
    assert isinstance(result.exception, SystemExit)


def test_ordinary_text_stays_as_it_is() -> None:
    body = json.dumps({"name": "Tücher, µ = 0.3\nnext"}, ensure_ascii=False).encode()
    assert json.loads(printable_json(body)) == {"name": "Tücher, µ = 0.3\nnext"}


def test_json_is_strict(capsys: pytest.CaptureFixture[str]) -> None:
    output.print_json({"a": [float("nan"), {"b": float("inf")}], "c": 1.5})
    text = capsys.readouterr().out

    def refuse(constant: str) -> float:
        raise AssertionError(constant)

    assert json.loads(text, parse_constant=refuse) == {"a": [None, {"b": None}], "c": 1.5}
