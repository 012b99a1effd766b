"""Keeping the data of a coordinator that does not run: removing versions, and files that nothing refers to.

python -m stickslip_services.upkeep rm DATASET:vN --data DIR
python -m stickslip_services.upkeep gc --data DIR [--older-than HOURS] [--delete]
"""

import argparse
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stickslip_schemas.store import Store, open_store

from stickslip_services.access.audit_log import acting, this_user
from stickslip_services.database.database import Database, Role
from stickslip_services.database.opening import check, opened
from stickslip_services.errors import ConflictError, DatabaseRefusedError, NotFoundError, SettingsError
from stickslip_services.local.process import locked
from stickslip_services.queue.removing import remove
from stickslip_services.queue.unused import unused
from stickslip_services.settings import Settings


def main(arguments: list[str] | None = None) -> int:
    """Do one thing; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m stickslip_services.upkeep", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    removing = verbs.add_parser("rm", help="remove a version of a dataset")
    removing.add_argument("version", help="DATASET:vN")
    collecting = verbs.add_parser("gc", help="find files that nothing refers to")
    collecting.add_argument("--older-than", type=float, default=24.0, help="hours since a file was written (24)")
    collecting.add_argument("--delete", action="store_true", help="delete them")
    for verb in (removing, collecting):
        verb.add_argument("--data", type=Path, required=True, help="directory of the database and the store")
        verb.add_argument("--store", help="directory of the store, or s3://BUCKET/PREFIX (DATA/store)")
    chosen = parser.parse_args(arguments)
    try:
        with _data(chosen.data, chosen.store) as (database, store):
            if chosen.verb == "rm":
                return _remove(database, store, chosen.version)
            return _collect(database, store, chosen.older_than, delete=chosen.delete)
    except (ConflictError, DatabaseRefusedError, NotFoundError, SettingsError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
    except OSError as error:
        sys.stderr.write(f"error: {error.filename or 'the store'}: {error.strerror or error}\n")
    return 1


@contextmanager
def _data(data: Path, place: str | None) -> Iterator[tuple[Database, Store]]:
    """Open what a coordinator left; raise DatabaseRefusedError where it runs, or where no database is."""
    settings = Settings.chosen(data=data, store=place)
    if not check(settings, Role.upkeep, with_store=True):
        raise DatabaseRefusedError(
            f"the database {settings.database_name} does not exist or is empty: name the "
            f"{settings.database_option} of a coordinator"
        )
    with locked(data), acting(this_user()), opened(settings, Role.upkeep) as database:
        yield database, open_store(settings.store_place)


def _remove(database: Database, store: Store, name: str) -> int:
    parts = re.fullmatch(r"(ds-[0-9a-f]{16}):v([1-9]\d{0,8})", name)
    if parts is None:
        raise ValueError(f"a version is written ds-0123456789abcdef:v1, and this is {name!r}")
    removed = remove(database, store, parts[1], int(parts[2]))
    sys.stdout.write(
        f"{name} is removed, with {removed.jobs} jobs and {removed.tasks} results that no other job needs\n"
        "to free the space: stickslip gc --delete --older-than 0\n"
    )
    return 0


def _collect(database: Database, store: Store, hours: float, *, delete: bool) -> int:
    if not hours >= 0:
        raise ValueError(f"--older-than must not be negative, and is {hours:g}")
    count = size = 0
    for file in unused(database, store, older_than=3600 * hours):
        count += 1
        size += file.bytes
        if delete:
            store.delete(file.name)
    done = "were deleted" if delete else "may be deleted: add --delete"
    sys.stdout.write(f"{count} files, {size / 1e6:,.1f} MB, that nothing refers to {done}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
