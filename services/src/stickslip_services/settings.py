"""Settings of the coordinator, from the environment (`STICKSLIP_...`) or the command line."""

import functools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import click
from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError
from stickslip_schemas.store import open_store, store_place
from stickslip_schemas.transport.addresses import DEFAULT_PORT, is_loopback

from stickslip_services.addresses import checked_prefix
from stickslip_services.errors import SettingsError

R = TypeVar("R")


_HOST = re.compile(r"[\w.-]+|\[[\da-fA-F:]+\]", re.ASCII)
"""A name or an address of a host, without a port; an IPv6 address is in brackets."""

_DATABASE_FORM = "a URL of the form postgresql://USER@HOST/NAME"


def _without_secrets(value: str, url: URL | None) -> str:
    """Return a wrong URL of a database for a message, without a password.

    Where the user, the password and the host of a malformed URL begin and end is a guess. So if
    there could be a password, only a URL that has been parsed is shown.
    """
    if url is not None and value.count("@") <= 1:
        return repr(url.set(query={}).render_as_string(hide_password=True))
    if {"@", "?"} & set(value):
        return "something else, which is not shown because it may hold a password"
    return repr(value[:100])


class Settings(BaseSettings):
    """Paths, addresses, limits and times of the coordinator."""

    model_config = SettingsConfigDict(
        env_prefix="STICKSLIP_", frozen=True, extra="forbid", use_attribute_docstrings=True
    )

    data: Path = Path("stickslip-data")
    """Directory of keys and logs, and by default of database and store (stickslip-data)."""
    store: str | None = None
    """Place of the store, a directory or `s3://BUCKET/PREFIX`; by default `store` in the data
    directory.
    """
    database: SecretStr | None = None
    """URL of a PostgreSQL database, `postgresql://USER@HOST/NAME`; give one with a password as
    STICKSLIP_DATABASE.
    """
    secrets_key: SecretStr | None = None
    """Key that seals secrets in the database, 32 bytes in base64; null: that of the file
    `data/secrets-key`.
    """
    host: str = "127.0.0.1"
    """Address to listen on (127.0.0.1); off loopback only with keys, and with TLS or behind a
    proxy.
    """
    port: int = Field(default=DEFAULT_PORT, ge=0, le=65535)
    """Port to listen on (8765); 0: any free one."""

    allowed_hosts: tuple[str, ...] = ()
    """Name that the coordinator may be asked by, besides loopback names and `host`; repeatable."""
    require_keys: bool = False
    """Refuse requests without a key on loopback, too."""
    behind_proxy: bool = False
    """A proxy in front of the coordinator terminates TLS; requests need keys."""
    root_path: str = ""
    """Path below which a proxy offers the coordinator, such as /stickslip; its header
    X-Forwarded-Prefix comes first.
    """
    tls_certificate: Path | None = None
    """File of the TLS certificate and its chain."""
    tls_key: Path | None = None
    """File of the private key of `tls_certificate`."""
    signing_key: Path | None = None
    """Private key of OpenSSH that signs the versions that are published."""

    durable: bool = True
    """Wait for the disk at each commit; tests turn it off. Without it a power cut may lose accepted
    results.
    """
    lease_seconds: float = Field(default=30.0, gt=0)
    """Duration of a lease without a heartbeat [s]."""
    max_tries: int = Field(default=3, ge=1)
    """Failed attempts after which a task fails."""
    max_losses: int = Field(default=20, ge=1)
    """Lost workers after which a task is quarantined. A loss is not a failed attempt."""
    max_quarantined: int = Field(default=10, ge=0)
    """Quarantined tasks of a job beyond which the job fails."""
    limit_floor_seconds: float = Field(default=60.0, gt=0)
    """Least time limit of a call [s]."""
    retry_seconds: float = Field(default=1.0, ge=0)
    """Delay before the second attempt [s]; it doubles with each further one."""
    sweep_seconds: float = Field(default=1.0, gt=0)
    """Polling interval for expired leases and due retries [s]."""
    plan_samples: int = Field(default=500, ge=1)
    """Largest job that is planned at once, and size of the pieces of larger ones [samples], 30 to
    60 ms each.
    """
    lease_limit: int = Field(default=1000, ge=1)
    """Largest number of tasks of one stage that a request gets."""
    min_free_bytes: int = Field(default=256 * 2**20, ge=0)
    """Free space on the disks of store and database below which jobs are paused [bytes]."""
    previews_per_job: int = Field(default=24, ge=0)
    """Samples of a job with a preview, evenly spread over its slots."""
    log_bytes: int = Field(default=16 * 2**20, ge=1024)
    """Size from which on `stickslip up` rotates a log [bytes]."""
    log_days: float = Field(default=30.0, gt=0, allow_inf_nan=False)
    """Age from which on `stickslip up` rotates a log [d]."""
    log_files: int = Field(default=5, ge=1, le=1000)
    """Rotated files of each log; the oldest one is deleted."""
    body_limit: int = Field(default=16 * 2**20, ge=1024)
    """Largest accepted request body [bytes]."""

    @classmethod
    def chosen(cls, **values: object) -> Self:
        """Return settings with these values; raise SettingsError.

        The environment has the settings that are not given.
        """
        settings = {name: value for name, value in values.items() if value not in (None, ())}
        try:
            return cls(**settings)  # type: ignore[arg-type]  # pydantic checks the types
        except ValidationError as error:
            rules = (
                item["msg"].removeprefix("Value error, ")
                for item in error.errors(include_input=False)
            )
            raise SettingsError("; ".join(rules)) from None

    @field_validator("allowed_hosts")
    @classmethod
    def _are_names(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        for host in hosts:
            if _HOST.fullmatch(host) is None:
                raise ValueError(
                    f"allowed_hosts must be names or addresses without a port; one is {host!r}"
                )
        return hosts

    @field_validator("root_path")
    @classmethod
    def _is_prefix(cls, root_path: str) -> str:
        try:
            return checked_prefix(root_path)
        except ValueError as error:
            raise ValueError(f"root_path {error}") from None

    @field_validator("store")
    @classmethod
    def _is_place(cls, store: str | None) -> str | None:
        if store is None:
            return None
        open_store(store)
        return store_place(store)

    @field_validator("database")
    @classmethod
    def _is_postgresql(cls, database: SecretStr | None) -> SecretStr | None:
        if database is None:
            return None
        value = database.get_secret_value()
        try:
            url = make_url(value)
        except (ArgumentError, ValueError):
            url = None
        if url is None or url.drivername != "postgresql" or not url.database:
            safe_value = _without_secrets(value, url)
            raise ValueError(f"database must be {_DATABASE_FORM}, and is {safe_value}")
        # SQLAlchemy splits at the first @, and takes the rest of the password for the host.
        user_part = value.partition("://")[2].rpartition("/")[0]
        if user_part.count("@") > 1:
            raise ValueError(
                f"database must be {_DATABASE_FORM}, with @ in a password written as %40; it has "
                "more than one @, and is not shown because it may hold a password"
            )
        return database

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> Self:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError(
                "tls_certificate and tls_key must be given together; one of them is missing"
            )
        for name in ("tls_certificate", "tls_key", "signing_key"):
            path: Path | None = getattr(self, name)
            if path is not None and not path.is_file():
                raise ValueError(f"{name} must be a file; {path} is not")
        if not (is_loopback(self.host) or self.tls_certificate or self.behind_proxy):
            raise ValueError(
                "host must be a loopback address unless the coordinator speaks TLS or a proxy "
                f"does it, because keys would be readable on the way; it is {self.host!r}. Give "
                "--tls-certificate and --tls-key, or --behind-proxy, or use 127.0.0.1 and an SSH "
                "tunnel."
            )
        return self

    @property
    def keys_required(self) -> bool:
        """Whether every request without a key is refused."""
        return (
            self.require_keys
            or self.behind_proxy
            or self.tls_certificate is not None
            or not is_loopback(self.host)
        )

    @property
    def database_url(self) -> URL | None:
        """URL of the PostgreSQL database, which shows no password when printed.

        None if it is SQLite.
        """
        if self.database is None:
            return None
        return make_url(self.database.get_secret_value()).set(drivername="postgresql+psycopg")

    @property
    def database_path(self) -> Path:
        """File of the database, where it is SQLite."""
        return self.data / "coordinator.sqlite3"

    @property
    def database_name(self) -> str:
        """Name of the database for messages, without a password."""
        url = self.database_url
        return (
            str(self.database_path)
            if url is None
            else url.set(drivername="postgresql", query={}).render_as_string()
        )

    @property
    def database_option(self) -> str:
        """The option of the command line that names another database."""
        return "--data" if self.database is None else "--database"

    @property
    def worker_key_path(self) -> Path:
        return self.data / "worker-key"

    @property
    def store_place(self) -> str:
        """Place of the store, as other processes of this machine understand it."""
        return str((self.data / "store").absolute()) if self.store is None else self.store

    @property
    def url(self) -> str:
        """URL of the coordinator on this machine."""
        # A coordinator that listens on all addresses is reached on loopback.
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        if ":" in host:
            host = f"[{host}]"
        scheme = "http" if self.tls_certificate is None else "https"
        return f"{scheme}://{host}:{self.port}"

    @property
    def variables(self) -> dict[str, str]:
        """Environment variables that give another process these settings, secrets included."""
        variables = {}
        for name in sorted(self.model_fields_set):
            value = getattr(self, name)
            if isinstance(value, SecretStr):
                text = value.get_secret_value()
            elif isinstance(value, tuple):
                text = json.dumps(value)
            else:
                text = str(value)
            variables[f"STICKSLIP_{name.upper()}"] = text
        return variables


def options(*names: str) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command options for some settings.

    It gets the settings first, with defaults for settings without an option.
    """

    def decorate(command: Callable[..., R]) -> Callable[..., R]:
        @functools.wraps(command)
        def run(**arguments: object) -> R:
            values = {name: arguments.pop(name) for name in names}
            return command(Settings.chosen(**values), **arguments)

        for name in reversed(names):
            field = Settings.model_fields[name]
            flag = "--allow-host" if name == "allowed_hosts" else f"--{name.replace('_', '-')}"
            run = click.option(
                flag, name, help=field.description, **_KINDS.get(field.annotation, {})
            )(run)
        return run

    return decorate


_PATH = click.Path(path_type=Path)
_KINDS: dict[Any, dict[str, Any]] = {
    bool: {"is_flag": True, "default": None},
    int: {"type": click.IntRange(0, 65535)},  # the only one is a port
    tuple[str, ...]: {"multiple": True},
    Path: {"type": _PATH},
    Path | None: {"type": _PATH},
}
"""How an option reads a setting, by its type."""

SERVER = (
    *("data", "store", "database", "host", "port", "allowed_hosts", "require_keys", "behind_proxy"),
    *("root_path", "tls_certificate", "tls_key", "signing_key"),
)
"""Settings that are options of a coordinator."""
