"""API keys, and the files of secrets in the data directory.

The database stores only the SHA-256 digests of the keys' secrets, which have 256 random bits and so
need no salt. A key belongs to one project, and so do the jobs submitted with it. Leases are divided
evenly between projects, and a project may have a quota.

A key may expire. A rotation makes a successor with the same name, scopes and project, and lets the
old key expire after an overlap, in which its holder changes to the new one.
"""

import secrets
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography.fernet import Fernet
from sqlalchemy import Connection, Row, func, insert, select, update
from stickslip_schemas.base import sha256
from stickslip_schemas.store import write_durably

from stickslip_services.access import audit_log
from stickslip_services.access.principals import (
    Principal,
    Scope,
    acting_as,
    check_project,
    local_user,
)
from stickslip_services.database.database import Database, Role, as_datetime
from stickslip_services.database.opening import opened
from stickslip_services.database.tables import api_keys
from stickslip_services.errors import (
    CommandError,
    ConflictError,
    InvalidKeyError,
    NotFoundError,
    SettingsError,
)
from stickslip_services.settings import Settings

LOCAL_WORKER = "local-worker"
"""Name of the key in the file `worker-key` of the data directory."""

FRESH_SECONDS = 1.0
"""Delay until a new or revoked key takes effect, at most [s]."""


@contextmanager
def command_transaction(settings: Settings) -> Iterator[Connection]:
    """Open a write transaction on a database for a command on this machine.

    Raise DatabaseRefusedError.

    A coordinator may run meanwhile.
    """
    with (
        acting_as(local_user()),
        opened(settings, Role.visitor) as database,
        database.write() as connection,
    ):
        yield connection


def create_key(
    connection: Connection,
    name: str,
    scopes: Collection[Scope],
    now: float,
    *,
    project: str = "",
    expires_at: float | None = None,
) -> tuple[str, str]:
    """Make a key; return its id and its secret, which is not stored.

    `now` and `expires_at` are in seconds since 1970; None: the key does not expire. Raise
    CommandError for a bad name or project.
    """
    if not 1 <= len(name) <= 100:
        raise CommandError(f"name must have 1 to 100 characters, and has {len(name)}")
    secret = _new_secret()
    key_id = _insert(
        connection,
        name,
        scopes,
        secret,
        now,
        project=check_project(project),
        expires_at=expires_at,
    )
    scope_names = [scope for scope in Scope if scope in scopes]
    expiry = {} if expires_at is None else {"expires": f"{as_datetime(expires_at):%Y-%m-%d %H:%M}"}
    audit_log.append(
        connection,
        "key.create",
        key_id,
        now,
        name=name,
        scopes=scope_names,
        project=project,
        **expiry,
    )
    return key_id, secret


@dataclass(frozen=True, slots=True)
class Rotation:
    """The successor of a key, and the end of the old key."""

    key_id: str
    secret: str
    expires_at: float | None
    """Expiry of the successor [s since 1970]; None: it does not expire."""
    old_digest: str
    old_expires_at: float
    """Expiry of the old key [s since 1970]."""


def rotate_key(
    connection: Connection, key_id: str, now: float, *, overlap: float, lifetime: float | None
) -> Rotation:
    """Make the successor of a key. Both are valid for `overlap` [s].

    `lifetime` is that of the successor [s]; None: as long as that of the old key. Raise
    NotFoundError if there is no such key, and ConflictError if it is no longer valid or has a
    successor.
    """
    old = connection.execute(select(api_keys).where(api_keys.c.id == key_id)).one_or_none()
    if old is None:
        raise NotFoundError(f"there is no key {key_id[:100]!r}")
    fault = _fault(old, now) or (f"has the successor {old.successor}" if old.successor else "")
    if fault:
        raise ConflictError(
            f"the key {key_id} {fault}: make another one with `stickslip keys create`"
        )
    if lifetime is None and old.expires_at is not None:
        lifetime = old.expires_at - old.created_at
    expires_at = None if lifetime is None else now + lifetime
    secret = _new_secret()
    scopes = [Scope(scope) for scope in old.scopes.split()]
    successor = _insert(
        connection, old.name, scopes, secret, now, project=old.project, expires_at=expires_at
    )
    # A rotation never prolongs the old key.
    old_expires_at = now + overlap
    if old.expires_at is not None:
        old_expires_at = min(old_expires_at, old.expires_at)
    connection.execute(
        update(api_keys)
        .where(api_keys.c.id == key_id)
        .values(expires_at=old_expires_at, successor=successor)
    )
    end = f"{as_datetime(old_expires_at):%Y-%m-%d %H:%M}"
    audit_log.append(connection, "key.rotate", key_id, now, successor=successor, expires=end)
    return Rotation(successor, secret, expires_at, old.digest, old_expires_at)


def replace_worker_key(path: Path, rotation: Rotation) -> bool:
    """Write a new secret to the file of the worker key, if the file has the old one.

    Return whether it has.
    """
    if not path.exists() or sha256(secret_in(path).encode()) != rotation.old_digest:
        return False
    write_durably(path, f"{rotation.secret}\n".encode(), mode=0o600)
    return True


def keys_that_expire(connection: Connection, now: float) -> Sequence[Row[Any]]:
    """Return the rows of the valid keys that expire and have no successor."""
    columns = api_keys.c
    return connection.execute(
        select(api_keys)
        .where(columns.revoked_at.is_(None), columns.successor.is_(None), columns.expires_at > now)
        .order_by(columns.seq)
    ).all()


def list_keys(connection: Connection) -> Sequence[Row[Any]]:
    """Return the rows of all keys, also the revoked ones, newest first."""
    return connection.execute(select(api_keys).order_by(api_keys.c.seq.desc())).all()


def revoke_key(connection: Connection, key_id: str, now: float) -> None:
    """Revoke a key.

    Raises NotFoundError if there is no such key.
    """
    # The row stays: the audit log names the key, and its first revocation counts.
    revoked = update(api_keys).values(revoked_at=func.coalesce(api_keys.c.revoked_at, now))
    if connection.execute(revoked.where(api_keys.c.id == key_id)).rowcount == 0:
        raise NotFoundError(f"there is no key {key_id[:100]!r}")
    audit_log.append(connection, "key.revoke", key_id, now)


def secret_in(path: Path) -> str:
    """Return the secret in a key file.

    Makes the file if it is missing, readable by its owner alone.
    """
    if not path.exists():
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_durably(path, f"{secrets.token_urlsafe(32)}\n".encode(), mode=0o600)
    return path.read_text(encoding="ascii").strip()


def sealer(settings: Settings) -> Fernet:
    """Return the cipher of secrets that the database keeps sealed.

    Raise SettingsError for a key of another form.
    """
    secret = settings.secrets_key
    key = secret_in(settings.data / "secrets-key") if secret is None else secret.get_secret_value()
    try:
        return Fernet(key.rstrip("=") + "=")
    except ValueError:
        raise SettingsError(
            "the secrets key must be 32 bytes in base64, as `openssl rand -base64 32` makes"
        ) from None


def admit_local_worker(connection: Connection, path: Path, now: float) -> None:
    """Register the secret of the local workers as a key of the scope `work`.

    A secret whose key was revoked or has expired is replaced.
    """
    digest = sha256(secret_in(path).encode())
    row = connection.execute(select(api_keys).where(api_keys.c.digest == digest)).one_or_none()
    if row is not None and _fault(row, now):
        path.unlink()
        row = None
    if row is None:
        _insert(connection, LOCAL_WORKER, (Scope.work,), secret_in(path), now)


@dataclass(frozen=True, slots=True)
class _Holder:
    """The holder of a key, and when the key expires [s since 1970]."""

    principal: Principal
    expires_at: float | None


class KeyRing:
    """Cache of the keys that were not revoked. Thread-safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._holders: dict[str, _Holder] = {}
        self._read_at = float("-inf")

    @property
    def is_fresh(self) -> bool:
        """Whether `holder_of` can answer without the database."""
        return time.monotonic() < self._read_at + FRESH_SECONDS

    def holder_of(self, secret: str) -> Principal:
        """Return the holder of a secret.

        Raises InvalidKeyError if the secret is unknown, revoked or expired.
        """
        with self._lock:
            # One request after the other reads the database once a second; the others use what it
            # has read, so that a request costs no query.
            if not self.is_fresh:
                self._holders = self._read()
                self._read_at = time.monotonic()
            holder = self._holders.get(sha256(secret.encode()))
        if holder is None:
            raise InvalidKeyError("the key is not known, or it was revoked")
        # Between two reads of the database, the clock alone ends a key.
        if holder.expires_at is not None and holder.expires_at <= self._database.clock():
            raise InvalidKeyError(f"the key {_expiry(holder.expires_at)}")
        return holder.principal

    def _read(self) -> dict[str, _Holder]:
        """Return the holders of all keys that were not revoked, by the digest of the secret."""
        holders: dict[str, _Holder] = {}
        with self._database.read() as connection:
            rows = connection.execute(select(api_keys).where(api_keys.c.revoked_at.is_(None)))
            for row in rows:
                scopes = frozenset(map(Scope, row.scopes.split()))
                principal = Principal(f"{row.id} {row.name}", scopes, row.project)
                holders[row.digest] = _Holder(principal, row.expires_at)
        return holders


def _fault(row: Row[Any], now: float) -> str:
    """Return why a key is not valid at a time [s since 1970]; an empty text if it is."""
    if row.revoked_at is not None:
        return "was revoked"
    if row.expires_at is not None and row.expires_at <= now:
        return _expiry(row.expires_at)
    return ""


def _expiry(seconds: float) -> str:
    return f"expired at {as_datetime(seconds):%Y-%m-%d %H:%M} UTC"


def _new_secret() -> str:
    # The prefix lets scanners of source code find a key that was committed by mistake.
    return f"sk_{secrets.token_urlsafe(32)}"


def _insert(
    connection: Connection,
    name: str,
    scopes: Collection[Scope],
    secret: str,
    now: float,
    *,
    project: str = "",
    expires_at: float | None = None,
) -> str:
    key_id = f"key-{secrets.token_hex(8)}"
    connection.execute(
        insert(api_keys).values(
            id=key_id,
            name=name,
            digest=sha256(secret.encode()),
            scopes=" ".join(scope for scope in Scope if scope in scopes),
            project=project,
            created_at=now,
            expires_at=expires_at,
        )
    )
    return key_id
