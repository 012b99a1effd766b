"""Webhooks: the coordinator tells other programs, by HTTP, that a job has another state or that a dataset is there.

Messages are signed as Standard Webhooks says [standardwebhooks.com, 1.0.0]. A webhook has a position among the events,
so nothing that has happened is forgotten, whoever is killed, and what happened first is told first. A message may come
twice; `webhook-id` is then the same.
"""

import json
import logging
import secrets
import threading
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime

import httpx
from sqlalchemy import ColumnElement, Connection, and_, delete, func, insert, or_, select, update
from standardwebhooks import Webhook as Signer
from stickslip_schemas.documents.responses import EventName

from stickslip_services.access.audit_log import note
from stickslip_services.addresses import is_loopback
from stickslip_services.clock import Clock, as_datetime
from stickslip_services.database.database import Database
from stickslip_services.database.tables import events, jobs, webhooks
from stickslip_services.errors import NotFoundError, SettingsError

logger = logging.getLogger(__name__)

ANSWER_SECONDS = 15.0
"""How long a receiver may take to answer [s]."""

CLAIM_SECONDS = 60.0
"""For how long the other coordinators leave a webhook to the one that is at it [s]."""

WAITS = (5.0, 60.0, 300.0, 1800.0, 7200.0, 21600.0)
"""Waits between the tries of a message [s]; the last one again and again."""

GIVE_UP_SECONDS = 5 * 24 * 3600.0
"""A webhook that has failed for so long, again and again, is told nothing any more [s]."""

TOLD = (EventName.job_state, EventName.dataset_published)
"""Which events are told."""


@dataclass(frozen=True, slots=True)
class Webhook:
    """A webhook without its secret."""

    id: str
    url: str
    failures: int
    failing_since: datetime | None
    fault: str
    created_at: datetime
    is_given_up: bool


def create_webhook(connection: Connection, url: str, now: float) -> tuple[Webhook, str]:
    """Make a webhook for what happens from now on; return it and its secret. Raise SettingsError for a bad URL."""
    _check(url)
    secret = f"whsec_{b64encode(secrets.token_bytes(32)).decode()}"
    name = f"hook-{secrets.token_hex(8)}"
    last = connection.scalar(select(func.max(events.c.id))) or 0
    connection.execute(
        insert(webhooks).values(
            id=name, url=url, secret=secret, position=last, next_at=now, failures=0, fault="", created_at=now
        )
    )
    note(connection, "webhook.create", name, now, url=url)
    return Webhook(name, url, 0, None, "", as_datetime(now), is_given_up=False), secret


def list_webhooks(connection: Connection, now: float) -> list[Webhook]:
    """Return all webhooks, newest first."""
    return [
        Webhook(
            id=row.id,
            url=row.url,
            failures=row.failures,
            failing_since=None if row.failing_since is None else as_datetime(row.failing_since),
            fault=row.fault,
            created_at=as_datetime(row.created_at),
            is_given_up=row.failing_since is not None and row.failing_since < now - GIVE_UP_SECONDS,
        )
        for row in connection.execute(select(webhooks).order_by(webhooks.c.seq.desc()))
    ]


def retry_webhook(connection: Connection, webhook_id: str, now: float) -> None:
    """Try again at once, also where the webhook was given up; raise NotFoundError."""
    _find(connection, webhook_id)
    values = {"next_at": now, "failures": 0, "failing_since": None}
    connection.execute(update(webhooks).where(webhooks.c.id == webhook_id).values(values))
    note(connection, "webhook.retry", webhook_id, now)


def delete_webhook(connection: Connection, webhook_id: str, now: float) -> None:
    """Forget a webhook; raise NotFoundError."""
    _find(connection, webhook_id)
    connection.execute(delete(webhooks).where(webhooks.c.id == webhook_id))
    note(connection, "webhook.delete", webhook_id, now)


class Messenger:
    """Delivers messages; several coordinators may do so on one database."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database = database
        self._clock = clock
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Let `deliver` end after the message that it is at."""
        self._stopping.set()

    def deliver(self) -> None:
        """Deliver to every webhook whose time has come all that it has not been told."""
        with self._database.read() as connection:
            due = connection.scalars(select(webhooks.c.seq).where(_is_due(self._clock()))).all()
            behind = [seq for seq in due if _next_message(connection, seq) is not None]
        for seq in behind:
            with self._claimed(seq) as is_ours:
                while is_ours and not self._stopping.is_set() and self._deliver_one(seq):
                    pass

    @contextmanager
    def _claimed(self, seq: int) -> Iterator[bool]:
        """Keep the other coordinators off a webhook."""
        until = self._clock() + CLAIM_SECONDS
        with self._database.write() as connection:
            due = and_(webhooks.c.seq == seq, _is_due(self._clock()))
            is_ours = connection.execute(update(webhooks).where(due).values(next_at=until)).rowcount == 1
        yield is_ours

    def _deliver_one(self, seq: int) -> bool:
        """Deliver the next message of a webhook; return whether another one may be sent at once."""
        with self._database.read() as connection:
            row = connection.execute(select(webhooks).where(webhooks.c.seq == seq)).one_or_none()
            message = None if row is None else _next_message(connection, seq)
        if row is None:
            return False
        place = update(webhooks).where(webhooks.c.seq == seq)
        if message is None:
            with self._database.write() as connection:
                connection.execute(place.values(next_at=self._clock()))
            return False
        fault = _send(row.url, row.secret, f"msg_{row.id}_{message.event}", message.body, self._clock())
        now = self._clock()
        if not fault:
            told = {"position": message.event, "failures": 0, "failing_since": None, "fault": ""}
            with self._database.write() as connection:
                connection.execute(place.values(told | {"next_at": now + CLAIM_SECONDS}))
            return True
        wait = WAITS[min(row.failures, len(WAITS) - 1)]
        logger.warning("webhook %s: %s; it is tried again in %g s", row.id, fault, wait)
        failed = {"failures": row.failures + 1, "failing_since": func.coalesce(webhooks.c.failing_since, now)}
        with self._database.write() as connection:
            connection.execute(place.values(failed | {"fault": fault, "next_at": now + wait}))
        return False


@dataclass(frozen=True, slots=True)
class _Message:
    event: int
    body: str


def _is_due(now: float) -> ColumnElement[bool]:
    given_up = webhooks.c.failing_since < now - GIVE_UP_SECONDS
    return and_(webhooks.c.next_at <= now, or_(webhooks.c.failing_since.is_(None), ~given_up))


def _next_message(connection: Connection, seq: int) -> _Message | None:
    """Return the first message that a webhook has not been told; None where it has been told everything."""
    position = select(webhooks.c.position).where(webhooks.c.seq == seq).scalar_subquery()
    found = connection.execute(
        select(events.c.id, events.c.name, events.c.data, events.c.created_at, jobs.c.id, jobs.c.name)
        .join(jobs, jobs.c.seq == events.c.job)
        .where(events.c.id > position, events.c.name.in_(TOLD))
        .order_by(events.c.id)
        .limit(1)
    ).one_or_none()
    if found is None:
        return None
    event, sort, data, created_at, job, name = found
    document = {
        "type": sort,
        "timestamp": as_datetime(created_at).isoformat(),
        "data": {"job": job, "name": name, **json.loads(data)},
    }
    return _Message(event, json.dumps(document))


def _send(url: str, secret: str, message_id: str, body: str, now: float) -> str:
    """Send a message; return what went wrong, or nothing."""
    headers = {
        "Content-Type": "application/json",
        "webhook-id": message_id,
        "webhook-timestamp": str(int(now)),
        "webhook-signature": Signer(secret).sign(message_id, as_datetime(int(now)), body),
    }
    try:
        response = httpx.post(url, content=body, headers=headers, timeout=ANSWER_SECONDS, trust_env=False)
    except httpx.HTTPError as error:
        return f"{type(error).__name__}: {error}"[:500]
    return "" if response.is_success else f"the receiver answered {response.status_code}, and 2xx was expected"


def _find(connection: Connection, webhook_id: str) -> None:
    if connection.scalar(select(webhooks.c.seq).where(webhooks.c.id == webhook_id)) is None:
        raise NotFoundError(f"there is no webhook {webhook_id[:100]!r}")


def _check(url: str) -> None:
    try:
        parts = httpx.URL(url)
    except httpx.InvalidURL:
        parts = httpx.URL("")
    if not parts.host or not (parts.scheme == "https" or (parts.scheme == "http" and is_loopback(parts.host))):
        raise SettingsError(f"url must be https://HOST/PATH, or http:// on this machine; got {url[:200]!r}")
