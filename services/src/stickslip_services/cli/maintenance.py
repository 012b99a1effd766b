"""Commands that maintain a coordinator's data: back up, remove, recover, and check."""

import re
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import click
from click.exceptions import Exit
from stickslip_schemas.store import Store, open_store

from stickslip_services.access.principals import acting_as, local_user
from stickslip_services.cli.common import amount, shows_errors
from stickslip_services.cli.output import say, tell
from stickslip_services.client.errors import ClientError
from stickslip_services.database.database import Database, Role
from stickslip_services.database.opening import check, opened
from stickslip_services.errors import CommandError, DatabaseRefusedError
from stickslip_services.local.supervisor import locked
from stickslip_services.queue.backup import make_backup
from stickslip_services.queue.context import Context
from stickslip_services.queue.maintenance import reindex as reindexed
from stickslip_services.queue.maintenance import remove, unused
from stickslip_services.queue.scrub import scrub as scrubbed
from stickslip_services.settings import Settings, options

BYTES_A_MEGABYTE = 1e6


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
    """Open the database and the store of a coordinator that is stopped.

    Nobody can start one in the meantime.

    Raises:
        DatabaseRefusedError: A coordinator runs.
        CommandError: A manifest in the store is damaged.
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
    # A running coordinator could give the version to a reader at this moment.
    with _owned(settings) as (database, files):
        jobs, tasks = remove(database, files, parts[1], int(parts[2]))
    tell(f"{version} is removed, with {jobs} jobs and {tasks} results that no other job needs")
    tell("to free the space: stickslip gc --delete --older-than 0")


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
    count = 0
    total_bytes = 0
    _refuse_none(settings, Role.upkeep)
    with _owned(settings) as (database, files):
        for file in unused(database, files, older_than=3600 * older_than):
            # Counted in both cases, so that a trial run tells what --delete would do.
            count += 1
            total_bytes += file.bytes
            if delete:
                files.delete(file.name)
    outcome = "were deleted" if delete else "may be deleted: add --delete"
    tell(
        f"{count} files, {total_bytes / BYTES_A_MEGABYTE:,.1f} MB, that nothing refers to {outcome}"
    )


@click.command()
@keeps
def reindex(settings: Settings) -> None:
    """Recover the datasets in the store after the database was lost.

    Known datasets stay as they are.
    """
    added = 0
    known = 0
    faulty = 0
    with _owned(settings) as (database, files):
        for version in reindexed(database, files):
            if version.fault:
                faulty += 1
                say(f"left out: {version.name}: {version.fault}")
            elif version.is_new:
                added += 1
                tell(f"{version.name}  {version.samples} samples")
            else:
                known += 1
    say(f"{added} versions found again, {known} known before, {faulty} left out")
    say(
        "certificates are not found again: run `stickslip register` with each of them, or "
        "`stickslip certify`"
    )
    raise Exit(1 if faulty else 0)


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
    count = 0
    damaged_count = 0
    _refuse_none(settings, Role.visitor)
    with acting_as(local_user()), closing(Context.open(settings, role=Role.visitor)) as context:
        began = context.clock()
        while True:
            # One version at a time, so that a stop loses little.
            checked = scrubbed(context, before=began, rate=BYTES_A_MEGABYTE * rate)
            if checked is None:
                break
            version, damaged_paths = checked
            count += 1
            damaged_count += bool(damaged_paths)
            for path in damaged_paths:
                tell(f"{version}  {path}")
    repair = ": a service with workers recomputes their files" if damaged_count else ""
    say(f"{count} versions read, {damaged_count} damaged{repair}")
    raise Exit(1 if damaged_count else 0)


@click.command()
@click.argument(
    "target", type=click.Path(path_type=Path, file_okay=False), help="empty, or an earlier backup"
)
@click.option("--bucket", "copies_bucket", is_flag=True, help="Download a store in a bucket, too.")
@keeps
def backup(settings: Settings, target: Path, copies_bucket: bool) -> None:
    """Copy database, store and keys to a directory, also while the service runs.

    Into an earlier backup, only new files are copied. A backup is a data directory: to restore it,
    copy it, and start the service with it. The dump of a PostgreSQL database needs pg_restore. A
    bucket is copied with --bucket only: it may be larger than a disk, and downloads cost. Exit
    with 1 if a file of the store is damaged, or was deleted meanwhile.
    """
    _refuse_none(settings, Role.visitor)
    copied = make_backup(settings, target, copies_bucket=copies_bucket)
    tell(
        f"{target} has {copied.artifacts:,} files, {copied.bytes / BYTES_A_MEGABYTE:,.1f} MB, of "
        f"which {copied.new_artifacts:,}, {copied.new_bytes / BYTES_A_MEGABYTE:,.1f} MB, are new"
    )
    is_in_bucket = settings.store is not None and settings.store.startswith("s3://")
    if is_in_bucket and not copies_bucket:
        say(
            f"{settings.store} is not copied: add --bucket, turn on versioning of the bucket, or "
            "replicate it"
        )
    for digest in copied.damaged:
        say(f"left out, because it is damaged: {digest}")
    for digest in copied.missing:
        say(f"left out, because it was deleted meanwhile: {digest}")
    if copied.missing:
        say("make the backup again, when `stickslip gc` has ended")
    if copied.damaged:
        say("`stickslip scrub` names the versions, and a service with workers recomputes the files")
    raise Exit(1 if copied.damaged or copied.missing else 0)
