"""Maintenance of a stopped coordinator's data: removing versions and unused files, and recovering a
lost database.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import click
from click.exceptions import Exit
from stickslip_schemas.store import Store, open_store

from stickslip_services.access.principals import acting_as, local_user
from stickslip_services.cli.common import amount, say, shows_errors
from stickslip_services.client.errors import ClientError
from stickslip_services.database.database import Database, Role
from stickslip_services.database.opening import check, opened
from stickslip_services.errors import CommandError, DatabaseRefusedError
from stickslip_services.local.supervisor import locked
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import scrub as scrubbed
from stickslip_services.queue.upkeep import reindex as reindexed
from stickslip_services.queue.upkeep import remove, unused
from stickslip_services.settings import Settings, options


def keeps(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of a coordinator's data, and show its errors."""
    return shows_errors(options("data", "store", "database")(command))


def _refuse_none(settings: Settings, role: Role) -> None:
    """Raise DatabaseRefusedError if there is no database."""
    if not check(settings, role, with_store=True):
        raise DatabaseRefusedError(
            f"the database {settings.database_name} does not exist or is empty: name the "
            f"{settings.database_option} of a coordinator"
        )


@contextmanager
def _owned(settings: Settings) -> Iterator[tuple[Database, Store]]:
    """Open the database and the store of a coordinator that is stopped, and keep others from
    starting one.

    Raise DatabaseRefusedError if one runs.
    """
    with locked(settings.data), acting_as(local_user()), opened(settings, Role.upkeep) as database:
        try:
            yield database, open_store(settings.store_place)
        except ValueError as error:  # a damaged manifest in the store
            raise CommandError(str(error)) from error


@click.command()
@click.argument("version", metavar="DATASET:vN", help="the version to remove")
@keeps
def rm(settings: Settings, version: str) -> None:
    """Remove a version of a dataset, with its jobs and the results that no other job needs.

    `stickslip gc --delete` then frees the space. Submitting its spec again makes the dataset again.
    """
    parts = re.fullmatch(r"(ds-[0-9a-f]{16}):v([1-9]\d{0,8})", version)
    if parts is None:
        raise ClientError(f"must be DATASET:vN, as in ds-0123456789abcdef:v1, and is {version!r}")
    _refuse_none(settings, Role.upkeep)
    with _owned(settings) as (database, files):
        jobs, tasks = remove(database, files, parts[1], int(parts[2]))
    click.echo(
        f"{version} is removed, with {jobs} jobs and {tasks} results that no other job needs"
    )
    click.echo("to free the space: stickslip gc --delete --older-than 0")


@click.command()
@click.option(
    "--older-than",
    type=amount("hours", 0),
    metavar="HOURS",
    default=24.0,
    help="keep files that are younger",
)
@click.option("--delete", is_flag=True, help="delete the files; default: only count them")
@keeps
def gc(settings: Settings, older_than: float, delete: bool) -> None:
    """Find the files of the store that nothing refers to, and delete them with --delete."""
    count = size = 0
    _refuse_none(settings, Role.upkeep)
    with _owned(settings) as (database, files):
        for file in unused(database, files, older_than=3600 * older_than):
            count += 1
            size += file.bytes
            if delete:
                files.delete(file.name)
    done = "were deleted" if delete else "may be deleted: add --delete"
    click.echo(f"{count} files, {size / 1e6:,.1f} MB, that nothing refers to {done}")


@click.command()
@keeps
def reindex(settings: Settings) -> None:
    """Recover the datasets in the store after the database was lost.

    Known datasets stay as they are.
    """
    counts = Counter[str]()
    with _owned(settings) as (database, files):
        for found in reindexed(database, files):
            if found.fault:
                say(f"left out: {found.name}: {found.fault}")
            elif found.is_new:
                click.echo(f"{found.name}  {found.samples} samples")
            counts["bad" if found.fault else "new" if found.is_new else "known"] += 1
    say(
        f"{counts['new']} versions found again, {counts['known']} known before, {counts['bad']} left out"
    )
    say(
        "certificates are not found again: run `stickslip register` with each of them, or `stickslip certify`"
    )
    raise Exit(1 if counts["bad"] else 0)


@click.command()
@click.option(
    "--rate",
    type=amount("MB/s", 0.1),
    metavar="MB/S",
    default=100.0,
    help="read so much a second at most",
)
@keeps
def scrub(settings: Settings, rate: float) -> None:
    """Read all datasets, beside a running service or without one; exit with 1 if a file is damaged.

    Workers recompute damaged files. With STICKSLIP_SIGNING_KEY, versions without a good signature
    are signed again. Versions that were read longest ago come first, also after a stop.
    """
    count = bad = 0
    _refuse_none(settings, Role.visitor)
    with acting_as(local_user()), closing(Context.open(settings, role=Role.visitor)) as context:
        began = context.clock()
        while (found := scrubbed(context, before=began, rate=1e6 * rate)) is not None:
            version, damaged = found
            count, bad = count + 1, bad + bool(damaged)
            for path in damaged:
                click.echo(f"{version}  {path}")
    say(
        f"{count} versions read, {bad} damaged"
        + (": a service with workers recomputes their files" if bad else "")
    )
    raise Exit(1 if bad else 0)
