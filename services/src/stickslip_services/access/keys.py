"""API keys, and the files of secrets in the data directory.

The database stores only the SHA-256 digests of the keys' secrets, which have 256 random bits and so
need no salt. A key belongs to one project, and so do the jobs submitted with it. Leases are divided
evenly between projects, and a project may have a quota.
"""

import secrets
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
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
from stickslip_services.database.database import Database, Role
from stickslip_services.database.opening import opened
from stickslip_services.database.tables import api_keys
from stickslip_services.errors import CommandError, NotFoundError, SettingsError
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
    connection: Connection, name: str, scopes: Collection[Scope], now: float, *, project: str = ""
) -> tuple[str, str]:
    """Make a key; return its id and its secret, which is not stored.

    Raise CommandError for a bad name or project.
    """
    if not 1 <= len(name) <= 100:
        raise CommandError(f"name must have 1 to 100 characters, and has {len(name)}")
    # The prefix lets scanners of source code find a key that was committed by mistake.
    secret = f"sk_{secrets.token_urlsafe(32)}"
    key_id = _insert(connection, name, scopes, secret, now, project=check_project(project))
    scope_names = [scope for scope in Scope if scope in scopes]
    audit_log.append(
        connection, "key.create", key_id, now, name=name, scopes=scope_names, project=project
    )
    return key_id, secret


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
    given = settings.secrets_key
    key = secret_in(settings.data / "secrets-key") if given is None else given.get_secret_value()
    try:
        return Fernet(key.rstrip("=") + "=")
    except ValueError:
        raise SettingsError(
            "the secrets key must be 32 bytes in base64, as `openssl rand -base64 32` makes"
        ) from None


def admit_local_worker(connection: Connection, path: Path, now: float) -> None:
    """Register the secret of the local workers as a key of the scope `work`.

    A secret whose key was revoked is replaced.
    """
    digest = sha256(secret_in(path).encode())
    row = connection.execute(
        select(api_keys.c.revoked_at).where(api_keys.c.digest == digest)
    ).one_or_none()
    if row is not None and row.revoked_at is not None:
        path.unlink()
        row = None
    if row is None:
        _insert(connection, LOCAL_WORKER, (Scope.work,), secret_in(path), now)


class KeyRing:
    """Cache of the valid keys. Thread-safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._holders: dict[str, Principal] = {}
        self._read_at = float("-inf")

    @property
    def is_fresh(self) -> bool:
        """Whether `holder_of` can answer without the database."""
        return time.monotonic() < self._read_at + FRESH_SECONDS

    def holder_of(self, secret: str) -> Principal | None:
        """Return the holder of a secret; None if it is unknown or revoked."""
        with self._lock:
            # One request after the other reads the database once a second; the others use what it
            # has read, so that a request costs no query.
            if not self.is_fresh:
                with self._database.read() as connection:
                    rows = connection.execute(
                        select(api_keys).where(api_keys.c.revoked_at.is_(None))
                    )
                    self._holders = {
                        row.digest: Principal(
                            f"{row.id} {row.name}",
                            frozenset(map(Scope, row.scopes.split())),
                            row.project,
                        )
                        for row in rows
                    }
                self._read_at = time.monotonic()
            return self._holders.get(sha256(secret.encode()))


def _insert(
    connection: Connection,
    name: str,
    scopes: Collection[Scope],
    secret: str,
    now: float,
    *,
    project: str = "",
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
        )
    )
    return key_id
