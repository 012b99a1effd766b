"""Maintenance of a stopped coordinator's data: removing versions and unused files, and recovering a lost database."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import click
from click.exceptions import Exit
from stickslip_schemas.store import Store, open_store

from stickslip_services.access.asker import asking, this_user
from stickslip_services.cli.common import (
    DEFAULT_DATA,
    FILE,
    P,
    R,
    amount,
    data_option,
    database_option,
    say,
    shows_errors,
    store_option,
)
from stickslip_services.client.errors import ClientError
from stickslip_services.database.database import Database, Role
from stickslip_services.database.opening import check, opened
from stickslip_services.errors import CommandError, DatabaseRefusedError
from stickslip_services.local.process import locked
from stickslip_services.queue.cleanup import remove, unused
from stickslip_services.queue.context import Context
from stickslip_services.queue.reindex import reindex as reindexed
from stickslip_services.queue.sweep import scrub as scrubbed
from stickslip_services.settings import Settings

_data_option = click.option(
    "--data", type=FILE, default=DEFAULT_DATA, help="data directory of a coordinator that is stopped"
)


def stopped(command: Callable[P, R]) -> Callable[P, R]:
    """Give a command the options of a coordinator that is stopped, and show its errors."""
    return _data_option(store_option(database_option(shows_errors(command))))


def _settings(data: Path, store: str | None, database: str | None, role: Role, *, is_new: bool = False) -> Settings:
    """Return the settings of a coordinator; raise DatabaseRefusedError if there is no database, unless `is_new`."""
    settings = Settings.chosen(data=data, store=store, database=database)
    if not is_new and not check(settings, role, with_store=True):
        raise DatabaseRefusedError(
            f"the database {settings.database_name} does not exist or is empty: name the "
            f"{settings.database_option} of a coordinator"
        )
    return settings


@contextmanager
def _owned(
    data: Path, store: str | None, database: str | None, *, is_new: bool = False
) -> Iterator[tuple[Database, Store]]:
    """Open the database and the store of a coordinator that is stopped, and keep others from starting one.

    Raise DatabaseRefusedError if one runs, or if there is no database and `is_new` does not allow to make one.
    """
    settings = _settings(data, store, database, Role.upkeep, is_new=is_new)
    with locked(data), asking(this_user()), opened(settings, Role.upkeep) as opened_database:
        try:
            yield opened_database, open_store(settings.store_place)
        except ValueError as error:  # a damaged manifest in the store
            raise CommandError(str(error)) from error


@click.command()
@click.argument("version", metavar="DATASET:vN", help="the version to remove")
@stopped
def rm(version: str, data: Path, store: str | None, database: str | None) -> None:
    """Remove a version of a dataset, with its jobs and the results that no other job needs.

    `stickslip gc --delete` then frees the space. Submitting its spec again makes the dataset again.
    """
    parts = re.fullmatch(r"(ds-[0-9a-f]{16}):v([1-9]\d{0,8})", version)
    if parts is None:
        raise ClientError(f"must be DATASET:vN, as in ds-0123456789abcdef:v1, and is {version!r}")
    with _owned(data, store, database) as (opened_database, files):
        jobs, tasks = remove(opened_database, files, parts[1], int(parts[2]))
    click.echo(f"{version} is removed, with {jobs} jobs and {tasks} results that no other job needs")
    click.echo("to free the space: stickslip gc --delete --older-than 0")


@click.command()
@click.option(
    "--older-than", type=amount("hours", 0), metavar="HOURS", default=24.0, help="keep files that are younger"
)
@click.option("--delete", is_flag=True, help="delete the files; default: only count them")
@stopped
def gc(data: Path, store: str | None, older_than: float, delete: bool, database: str | None) -> None:
    """Find the files of the store that nothing refers to, and delete them with --delete."""
    count = size = 0
    with _owned(data, store, database) as (opened_database, files):
        for file in unused(opened_database, files, older_than=3600 * older_than):
            count += 1
            size += file.bytes
            if delete:
                files.delete(file.name)
    done = "were deleted" if delete else "may be deleted: add --delete"
    click.echo(f"{count} files, {size / 1e6:,.1f} MB, that nothing refers to {done}")


@click.command()
@stopped
def reindex(data: Path, store: str | None, database: str | None) -> None:
    """Recover the datasets in the store after the database was lost. Known datasets stay as they are."""
    counts = Counter[str]()
    with _owned(data, store, database, is_new=True) as (opened_database, files):
        for found in reindexed(opened_database, files):
            if found.fault:
                say(f"left out: {found.name}: {found.fault}")
            elif found.is_new:
                click.echo(f"{found.name}  {found.samples} samples")
            counts["bad" if found.fault else "new" if found.is_new else "known"] += 1
    say(f"{counts['new']} versions found again, {counts['known']} known before, {counts['bad']} left out")
    say("certificates are not found again: run `stickslip register` with each of them, or `stickslip certify`")
    raise Exit(1 if counts["bad"] else 0)


@click.command()
@data_option
@store_option
@database_option
@click.option("--rate", type=amount("MB/s", 0.1), metavar="MB/S", default=100.0, help="read so much a second at most")
@shows_errors
def scrub(data: Path, store: str | None, database: str | None, rate: float) -> None:
    """Read all datasets, beside a running service or without one; exit with 1 if a file is damaged.

    Workers recompute damaged files. With STICKSLIP_SIGNING_KEY, versions without a good signature are signed again.
    Versions that were read longest ago come first, also after a stop.
    """
    count = bad = 0
    settings = _settings(data, store, database, Role.visitor)
    with asking(this_user()), closing(Context.open(settings, role=Role.visitor)) as context:
        began = context.clock()
        while (found := scrubbed(context, before=began, rate=1e6 * rate)) is not None:
            version, damaged = found
            count, bad = count + 1, bad + bool(damaged)
            for path in damaged:
                click.echo(f"{version}  {path}")
    say(f"{count} versions read, {bad} damaged" + (": a service with workers recomputes their files" if bad else ""))
    raise Exit(1 if bad else 0)
