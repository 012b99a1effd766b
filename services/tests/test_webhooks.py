"""Webhooks: every event is delivered, in order and signed, whatever its receivers do."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from cryptography.fernet import Fernet
from sqlalchemy import select
from standardwebhooks import Webhook as Verifier
from stickslip_services.access import webhooks
from stickslip_services.access.keys import sealer
from stickslip_services.access.webhooks import (
    CLAIM_SECONDS,
    GIVE_UP_SECONDS,
    WAITS,
    WebhookDelivery,
    create_webhook,
    list_webhooks,
    retry_webhook,
)
from stickslip_services.cli import app
from stickslip_services.database import tables
from stickslip_services.errors import SettingsError
from stickslip_services.queue.context import Context
from stickslip_services.queue.submit import submit_job
from stickslip_testing.jobs import ManualClock, parsed, rods
from stickslip_testing.servers import RunningServer, wait_until
from stickslip_testing.worker import PretendWorker

pytestmark = pytest.mark.databases


class Receiver:
    """Keeps all messages, and answers with preset statuses."""

    def __init__(self) -> None:
        self.status = 204
        self.received: list[tuple[dict[str, str], str]] = []
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                receiver.received.append(
                    ({name.lower(): value for name, value in self.headers.items()}, body)
                )
                self.send_response(receiver.status)
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/hook"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def messages(self) -> list[tuple[str, str]]:
        """The sort of each message, and the state or the dataset that it tells."""
        documents = [json.loads(body) for _, body in self.received]
        return [(document["type"], document["data"].get("state", "v1")) for document in documents]

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    registered = Receiver()
    yield registered
    registered.close()


@pytest.fixture
def messenger(context: Context, monkeypatch: pytest.MonkeyPatch) -> WebhookDelivery:
    monkeypatch.setattr(
        webhooks, "WAIT_SECONDS", 20.0
    )  # a busy machine must not leave a delivery for later
    return WebhookDelivery(context.database, context.clock, sealer(context.settings))


def registered(context: Context, url: str) -> tuple[str, str]:
    """Make a webhook; return its id and its secret."""
    with context.database.write() as connection:
        webhook, secret = create_webhook(connection, sealer(context.settings), url, context.clock())
    return webhook, secret


def run_job(context: Context, worker: PretendWorker, gamma: float) -> None:
    submit_job(context, parsed(rods(gamma=(gamma,), name="of-a-test")), None)
    worker.work()


ONE_JOB = [("job.state", "running"), ("dataset.published", "v1"), ("job.state", "succeeded")]


def test_what_happens_is_told_in_order_and_signed(
    context: Context, worker: PretendWorker, messenger: WebhookDelivery, receiver: Receiver
) -> None:
    run_job(context, worker, 1.0)  # before anybody wanted to know
    name, secret = registered(context, receiver.url)
    messenger.run()
    assert receiver.messages == []
    run_job(context, worker, 2.0)
    messenger.run()
    messenger.run()
    assert [
        message for message in receiver.messages if message != ("job.state", "queued")
    ] == ONE_JOB
    ids = [headers["webhook-id"] for headers, _ in receiver.received]
    assert len(set(ids)) == len(ids)
    for headers, body in receiver.received:
        at = datetime.fromtimestamp(int(headers["webhook-timestamp"]), UTC)
        assert headers["webhook-signature"] == Verifier(secret).sign(
            headers["webhook-id"], at, body
        )
        assert headers["webhook-id"].startswith(f"msg_{name}_")
        document = json.loads(body)
        assert document["data"]["name"] == "of-a-test"
        assert document["data"]["job"].startswith("job-")
    published = json.loads(receiver.received[-2][1])["data"]["dataset"]
    assert published["version"] == 1


def test_a_message_that_fails_holds_up_the_others_and_is_sent_again(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    messenger: WebhookDelivery,
    receiver: Receiver,
) -> None:
    registered(context, receiver.url)
    receiver.status = 500
    run_job(context, worker, 1.0)
    for wait in (*WAITS, WAITS[-1]):
        before = len(receiver.received)
        messenger.run()
        messenger.run()
        assert len(receiver.received) == before + 1
        clock.advance(wait - 1)
        messenger.run()
        assert len(receiver.received) == before + 1
        clock.advance(1)
    assert len({headers["webhook-id"] for headers, _ in receiver.received}) == 1
    with context.database.read() as connection:
        (hook,) = list_webhooks(connection, clock())
    assert (hook.failures, hook.is_given_up) == (len(WAITS) + 1, False)
    assert hook.fault == "the receiver answered 500, and 2xx was expected"
    receiver.status = 200
    receiver.received.clear()
    messenger.run()
    assert [
        message for message in receiver.messages if message != ("job.state", "queued")
    ] == ONE_JOB
    with context.database.read() as connection:
        (hook,) = list_webhooks(connection, clock())
    assert (hook.failures, hook.failing_since, hook.fault) == (0, None, "")


def test_a_receiver_that_is_away_for_days_is_given_up_until_somebody_says_otherwise(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    messenger: WebhookDelivery,
    receiver: Receiver,
) -> None:
    name, _ = registered(context, receiver.url)
    receiver.status = 503
    run_job(context, worker, 1.0)
    end = clock() + GIVE_UP_SECONDS
    while clock() <= end:
        messenger.run()
        clock.advance(WAITS[-1])
    receiver.status = 200
    receiver.received.clear()
    messenger.run()
    assert receiver.received == []
    with context.database.write() as connection:
        assert list_webhooks(connection, clock())[0].is_given_up
        retry_webhook(connection, name, clock())
    messenger.run()
    assert [
        message for message in receiver.messages if message != ("job.state", "queued")
    ] == ONE_JOB


def test_nobody_is_told_twice_by_two_coordinators_and_the_other_goes_on_when_one_dies(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    messenger: WebhookDelivery,
    receiver: Receiver,
) -> None:
    registered(context, receiver.url)
    run_job(context, worker, 1.0)
    other = WebhookDelivery(context.database, context.clock, sealer(context.settings))
    assert messenger._claim(1)  # and here it is killed
    other.run()
    assert receiver.received == []
    clock.advance(CLAIM_SECONDS)
    threads = [threading.Thread(target=delivery.run) for delivery in (messenger, other)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [
        delivery for delivery in receiver.messages if delivery != ("job.state", "queued")
    ] == ONE_JOB


@pytest.mark.parametrize(("stopped", "wait"), [(False, WAITS[0]), (True, 0.0)])
def test_a_delivery_that_ends_in_its_middle_is_tried_again_without_the_wait_of_its_claim(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    receiver: Receiver,
    monkeypatch: pytest.MonkeyPatch,
    stopped: bool,
    wait: float,
) -> None:
    monkeypatch.setattr(webhooks, "WAIT_SECONDS", 20.0)
    registered(context, receiver.url)
    run_job(context, worker, 1.0)
    messenger = WebhookDelivery(context.database, context.clock, sealer(context.settings))
    if stopped:
        messenger.stop()
    else:
        monkeypatch.setattr(messenger, "_deliver_one", lambda _seq: 1 / 0)
        monkeypatch.setattr(threading, "excepthook", lambda _error: None)
    messenger.run()
    other = WebhookDelivery(context.database, context.clock, sealer(context.settings))
    if wait:
        other.run()
        assert receiver.received == []
    clock.advance(wait)
    other.run()
    assert [
        message for message in receiver.messages if message != ("job.state", "queued")
    ] == ONE_JOB


def test_a_copy_of_the_database_has_no_secret(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    messenger: WebhookDelivery,
    receiver: Receiver,
) -> None:
    name, secret = registered(context, receiver.url)
    with context.database.read() as connection:
        sealed = connection.scalar(
            select(tables.webhooks.c.secret).where(tables.webhooks.c.id == name)
        )
    assert sealed is not None
    assert secret.removeprefix("whsec_") not in sealed
    assert sealer(context.settings).decrypt(sealed).decode() == secret
    assert (context.settings.data / "secrets-key").stat().st_mode & 0o777 == 0o600
    run_job(context, worker, 1.0)
    WebhookDelivery(context.database, context.clock, Fernet(Fernet.generate_key())).run()
    wait_until(lambda: "sealed with another secrets key" in fault_of(context, name))
    assert receiver.messages == []
    clock.advance(WAITS[0])
    messenger.run()
    assert receiver.messages != []


def fault_of(context: Context, name: str) -> str:
    with context.database.read() as connection:
        return next(
            str(hook.fault)
            for hook in list_webhooks(connection, context.clock())
            if hook.id == name
        )


def test_a_receiver_that_does_not_listen_is_a_fault_and_no_error(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    messenger: WebhookDelivery,
    receiver: Receiver,
) -> None:
    receiver.close()
    registered(context, receiver.url)
    run_job(context, worker, 1.0)
    messenger.run()
    with context.database.read() as connection:
        (hook,) = list_webhooks(connection, clock())
    assert "ConnectError" in hook.fault


def test_a_receiver_that_trickles_holds_up_no_other(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    messenger: WebhookDelivery,
    receiver: Receiver,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(webhooks, "ANSWER_SECONDS", 4.0)
    monkeypatch.setattr(webhooks, "WAIT_SECONDS", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as slow:
        threading.Thread(target=trickle, args=(slow,), daemon=True).start()
        slow_hook, _ = registered(context, f"http://127.0.0.1:{slow.getsockname()[1]}/")
        registered(context, receiver.url)
        run_job(context, worker, 1.0)
        began = time.monotonic()
        messenger.run()
        wait_until(
            lambda: [message for message in receiver.messages if message[1] != "queued"] == ONE_JOB,
            seconds=3,
        )
        assert time.monotonic() - began < 3.8

        wait_until(lambda: "did not answer within 4 s" in fault_of(context, slow_hook), seconds=20)


def trickle(server: socket.socket) -> None:
    """Answer with one byte every 0.2 s."""
    with suppress(OSError), server.accept()[0] as line:
        for byte in b"HTTP/1.1 204 No Content\r\n" * 100:
            line.sendall(bytes([byte]))
            time.sleep(0.2)


@pytest.mark.parametrize(
    "url", ["http://example.org/hook", "ftp://127.0.0.1/", "https://", "hook", "http://[", ""]
)
def test_urls_that_anybody_could_read_are_refused(context: Context, url: str) -> None:
    with pytest.raises(SettingsError, match="url must be https"):
        registered(context, url)


def test_the_command_line_makes_and_a_coordinator_delivers(
    server: RunningServer, receiver: Receiver, tmp_path: Path
) -> None:
    def cli(*arguments: str) -> Any:
        words = ["webhooks", *arguments, "--data", str(server.data)]
        return CliRunner().invoke(app, words, env={"COLUMNS": "200"})

    secret = cli("create", receiver.url).stdout.strip()
    assert secret.startswith("whsec_")
    listed = cli("list").stdout
    assert receiver.url in listed
    assert secret not in listed
    httpx.post(f"{server.url}/v1/jobs", json=rods(), trust_env=False).raise_for_status()
    worker = server.worker()
    wait_until(lambda: worker.work() > 0)
    wait_until(lambda: receiver.messages[-1:] == [("job.state", "succeeded")])
    for headers, body in receiver.received:
        Verifier(secret).verify(body, headers)
    (name,) = (word for word in listed.split() if word.startswith("hook-"))
    assert cli("retry", name).exit_code == 0
    assert cli("delete", name).exit_code == 0
    assert receiver.url not in cli("list").stdout
    gone = cli("delete", name)
    assert gone.exit_code == 1
    assert f"there is no webhook '{name}'" in gone.output
