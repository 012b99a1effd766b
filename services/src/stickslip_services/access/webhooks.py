"""Webhooks: URLs that receive job events, i.e. changes of a job's state and published datasets.

Messages are signed according to Standard Webhooks 1.0.0 [standardwebhooks.com]. A webhook stores
its position in the sequence of events, so events arrive in order, and none is lost when a process
is killed. A message may arrive twice, with the same `webhook-id`.
"""

import asyncio
import json
import logging
import secrets
import threading
import time
from base64 import b64encode
from collections.abc import Sequence
from typing import Any

import httpx
from cryptography.fernet import Fernet, InvalidToken
from sqlalchemy import ColumnElement, Connection, Row, and_, delete, func, insert, select, update
from standardwebhooks import Webhook as Signer
from stickslip_schemas.documents.responses import EventName
from stickslip_schemas.transport.addresses import is_loopback

from stickslip_services.access import audit_log
from stickslip_services.access.principals import check_project
from stickslip_services.database.database import Clock, Database, as_datetime
from stickslip_services.database.tables import events, jobs, webhooks
from stickslip_services.errors import NotFoundError, SettingsError

logger = logging.getLogger(__name__)

ANSWER_SECONDS = 15.0
"""Time that a receiver has for its answer, from the first attempt to connect to the status [s]."""

MAX_DELIVERIES = 32
"""Webhooks that are delivered to at the same time."""

WAIT_SECONDS = 1.0
"""Time that one round waits for its deliveries [s]; slower ones go on beside the next round."""

CLAIM_SECONDS = 60.0
"""Duration of a coordinator's claim on a webhook [s]."""

WAITS = (5.0, 60.0, 300.0, 1800.0, 7200.0, 21600.0)
"""Waits between the tries of a message [s]; the last one repeats."""

GIVE_UP_SECONDS = 5 * 24 * 3600.0
"""A webhook that has failed for this long receives no further messages [s]."""

DELIVERED = (EventName.job_state, EventName.dataset_published)
"""Events that are delivered."""


def create_webhook(
    connection: Connection, sealing: Fernet, url: str, now: float, *, project: str = ""
) -> tuple[str, str]:
    """Make a webhook for events of the jobs of a project from now on.

    Return its id and its secret, kept sealed.

    Raises SettingsError for a bad URL, ValueError for a bad project.
    """
    _check(url)
    secret = f"whsec_{b64encode(secrets.token_bytes(32)).decode()}"
    name = f"hook-{secrets.token_hex(8)}"
    # Events before now are not delivered.
    last = connection.scalar(select(func.max(events.c.id))) or 0
    connection.execute(
        insert(webhooks).values(
            id=name,
            project=check_project(project),
            url=url,
            secret=sealing.encrypt(secret.encode()).decode(),
            position=last,
            next_at=now,
            failures=0,
            fault="",
            created_at=now,
        )
    )
    audit_log.append(connection, "webhook.create", name, now, url=url, project=project)
    return name, secret


def list_webhooks(connection: Connection, now: float) -> Sequence[Row[Any]]:
    """Return the rows of all webhooks, newest first, and whether each `is_given_up`."""
    query = select(webhooks, _is_given_up(now).label("is_given_up"))
    return connection.execute(query.order_by(webhooks.c.seq.desc())).all()


def retry_webhook(connection: Connection, webhook_id: str, now: float) -> None:
    """Retry a webhook at once, even if it was given up; raise NotFoundError."""
    values = {"next_at": now, "failures": 0, "failing_since": None}
    row_update = update(webhooks).where(webhooks.c.id == webhook_id).values(values)
    if connection.execute(row_update).rowcount == 0:
        raise NotFoundError(f"there is no webhook {webhook_id[:100]!r}")
    audit_log.append(connection, "webhook.retry", webhook_id, now)


def delete_webhook(connection: Connection, webhook_id: str, now: float) -> None:
    """Delete a webhook; raise NotFoundError."""
    if connection.execute(delete(webhooks).where(webhooks.c.id == webhook_id)).rowcount == 0:
        raise NotFoundError(f"there is no webhook {webhook_id[:100]!r}")
    audit_log.append(connection, "webhook.delete", webhook_id, now)


class WebhookDelivery:
    """Delivers messages; several coordinators may do so on one database."""

    def __init__(self, database: Database, clock: Clock, sealing: Fernet) -> None:
        self._database = database
        self._clock = clock
        self._sealing = sealing
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Let `run` end after the current message."""
        self._stopping.set()

    def run(self) -> None:
        """Deliver all events that webhooks have not received, unless they wait for a retry.

        Each webhook has a thread of its own, so a slow receiver holds up no other. The threads of
        slow ones go on when this returns.
        """
        # A claim is a write, so only webhooks that have something to receive are claimed.
        with self._database.read() as connection:
            due = connection.scalars(select(webhooks.c.seq).where(_is_due(self._clock()))).all()
            behind = [seq for seq in due if _next_message(connection, seq) is not None]
        threads = [
            threading.Thread(target=self._deliver, args=(seq,), daemon=True)
            for seq in behind[:MAX_DELIVERIES]
        ]
        for thread in threads:
            thread.start()
        end = time.monotonic() + WAIT_SECONDS
        for thread in threads:
            thread.join(max(0.0, end - time.monotonic()))

    def _claim(self, seq: int) -> bool:
        """Claim a webhook, or return False if another coordinator or thread has it."""
        due = and_(webhooks.c.seq == seq, _is_due(self._clock()))
        claim = update(webhooks).where(due).values(next_at=self._clock() + CLAIM_SECONDS)
        with self._database.write() as connection:
            return connection.execute(claim).rowcount == 1

    def _deliver(self, seq: int) -> None:
        """Deliver the messages of a webhook, and give its claim back, however that ends."""
        if not self._claim(seq):
            return
        wait: float | None = None
        try:
            while wait is None and not self._stopping.is_set():
                wait = WAITS[0]  # the wait if it raises
                wait = self._deliver_one(seq)
        finally:
            with self._database.write() as connection:
                row_update = update(webhooks).where(webhooks.c.seq == seq)
                connection.execute(row_update.values(next_at=self._clock() + (wait or 0.0)))

    def _deliver_one(self, seq: int) -> float | None:
        """Deliver the next message of a webhook.

        Return the wait before the next try [s], None for another message.
        """
        with self._database.read() as connection:
            row = connection.execute(select(webhooks).where(webhooks.c.seq == seq)).one_or_none()
            message = None if row is None else _next_message(connection, seq)
        if row is None or message is None:
            return 0.0
        row_update = update(webhooks).where(webhooks.c.seq == seq)
        event, body = message
        try:
            secret = self._sealing.decrypt(row.secret.encode()).decode()
            fault = _send(row.url, secret, f"msg_{row.id}_{event}", body, self._clock())
        except InvalidToken:
            fault = (
                "its secret is damaged, or was sealed with another secrets key: "
                "make the webhook again"
            )
        now = self._clock()
        # The position moves with each message that was received, so none is lost or skipped.
        if not fault:
            delivered = {"position": event, "failures": 0, "failing_since": None, "fault": ""}
            with self._database.write() as connection:
                connection.execute(row_update.values(delivered | {"next_at": now + CLAIM_SECONDS}))
            return None
        # The message stays the next one, which keeps events in order.
        wait = WAITS[min(row.failures, len(WAITS) - 1)]
        logger.warning("webhook %s: %s; it is tried again in %g s", row.id, fault, wait)
        failed = {
            "failures": row.failures + 1,
            "failing_since": func.coalesce(webhooks.c.failing_since, now),
        }
        with self._database.write() as connection:
            connection.execute(row_update.values(failed | {"fault": fault}))
        return wait


def _is_due(now: float) -> ColumnElement[bool]:
    return and_(webhooks.c.next_at <= now, ~_is_given_up(now))


def _is_given_up(now: float) -> ColumnElement[bool]:
    return func.coalesce(webhooks.c.failing_since, now) < now - GIVE_UP_SECONDS


def _next_message(connection: Connection, seq: int) -> tuple[int, str] | None:
    """Return the first event that a webhook has not received, and its message.

    None if it has received all.
    """
    row = connection.execute(
        select(
            events.c.id, events.c.name, events.c.data, events.c.created_at, jobs.c.id, jobs.c.name
        )
        .join(jobs, jobs.c.seq == events.c.job)
        .join(webhooks, webhooks.c.project == jobs.c.project)
        .where(
            webhooks.c.seq == seq, events.c.id > webhooks.c.position, events.c.name.in_(DELIVERED)
        )
        .order_by(events.c.id)
        .limit(1)
    ).one_or_none()
    if row is None:
        return None
    event, event_name, data, created_at, job, name = row
    document = {
        "type": event_name,
        "timestamp": as_datetime(created_at).isoformat(),
        "data": {"job": job, "name": name, **json.loads(data)},
    }
    return event, json.dumps(document, allow_nan=False)


def _send(url: str, secret: str, message_id: str, body: str, now: float) -> str:
    """Send a message; return the fault, or an empty string."""
    headers = {
        "Content-Type": "application/json",
        "webhook-id": message_id,
        "webhook-timestamp": str(int(now)),
        "webhook-signature": Signer(secret).sign(message_id, as_datetime(int(now)), body),
    }
    try:
        status = asyncio.run(asyncio.wait_for(_status(url, body, headers), ANSWER_SECONDS))
    except TimeoutError:
        return f"the receiver did not answer within {ANSWER_SECONDS:g} s"
    except httpx.HTTPError as error:
        return f"{type(error).__name__}: {error}"[:500]
    return "" if 200 <= status < 300 else f"the receiver answered {status}, and 2xx was expected"


async def _status(url: str, body: str, headers: dict[str, str]) -> int:
    """Post a message; return the status of the answer, whose body is not read."""
    # The caller limits the whole delivery. A proxy of the environment is for clients.
    client = httpx.AsyncClient(timeout=None, trust_env=False)
    async with client, client.stream("POST", url, content=body, headers=headers) as response:
        return response.status_code


def _check(url: str) -> None:
    try:
        parts = httpx.URL(url)
    except httpx.InvalidURL:
        parts = httpx.URL("")
    if not parts.host or not (
        parts.scheme == "https" or (parts.scheme == "http" and is_loopback(parts.host))
    ):
        raise SettingsError(
            f"url must be https://HOST/PATH, or http:// on this machine; got {url[:200]!r}"
        )
