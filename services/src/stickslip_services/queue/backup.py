"""Backup of a coordinator's data, also while it runs.

A backup is a data directory: the database, a copy of the store, and the keys. Artifacts are written
before a row refers to them, and only a stopped coordinator deletes them. So the database is copied
first, in one read transaction, and the store afterwards: the copy has all that its database needs,
and this is checked. The database gets its name last, so a backup that was interrupted leaves the
one before.
"""

import os
import shutil
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from stickslip_schemas.base import Document, is_sha256, sha256
from stickslip_schemas.store import (
    DATASETS,
    VERSION,
    CorruptArtifactError,
    DirectoryStore,
    Store,
    open_store,
    write_durably,
)

from stickslip_services import __version__
from stickslip_services.database.database import Database, Role, SqliteDatabase
from stickslip_services.database.opening import check, connect
from stickslip_services.errors import CommandError
from stickslip_services.local.supervisor import locked
from stickslip_services.queue.maintenance import needed_artifacts
from stickslip_services.settings import Settings

RECORD_NAME = "backup.json"
DUMP_NAME = "database.dump"
_KEY_NAMES = ("worker-key", "secrets-key")


class BackupRecord(Document):
    """The file `backup.json`: what a backup contains. It is written last."""

    version: str
    """Version of stickslip."""
    made_at: float
    """Time of the copy of the database [s since 1970]."""
    database: str
    """Name of the file with the database."""
    store: str
    """Directory of the copy of the store, or the URL of a bucket that was not copied."""
    artifacts: int
    bytes: int
    """Size of the artifacts [bytes]."""


@dataclass(slots=True)
class Backup:
    """What a backup has copied."""

    artifacts: int = 0
    bytes: int = 0
    """Size of all artifacts [bytes]."""
    new_artifacts: int = 0
    new_bytes: int = 0
    """Size of the artifacts that an earlier backup did not have [bytes]."""
    damaged: list[str] = field(default_factory=list)
    """Digests of artifacts whose bytes differ: they are left out."""
    missing: list[str] = field(default_factory=list)
    """Digests of artifacts that the database needs and that were deleted during the copy."""


def make_backup(settings: Settings, target: Path, *, copies_bucket: bool = False) -> Backup:
    """Copy database, store and keys to a directory, which may hold an earlier backup.

    A store in a bucket is copied only with `copies_bucket`: it may be larger than a disk.

    Raises:
        CommandError: The target holds something else, or the database cannot be copied.
        DatabaseRefusedError: There is no database, or the target is in use.
    """
    if target.exists() and any(target.iterdir()) and not (target / RECORD_NAME).is_file():
        raise CommandError(
            f"{target} must be empty or hold an earlier backup, which has the file {RECORD_NAME}"
        )
    if not check(settings, Role.visitor, with_store=True):
        raise CommandError(f"there is no database {settings.database_name}")
    # A service may run on an earlier backup, which is a data directory.
    with locked(target):
        store = open_store(settings.store_place)
        made_at = time.time()
        with _copied_database(settings, target, copies_bucket) as (name, needed):
            backup, copy = _copy_store(store, target, copies_bucket)
            backup.missing = _missing(copy, needed, backup.damaged)
            for key in _KEY_NAMES:
                with suppress(FileNotFoundError):
                    write_durably(target / key, (settings.data / key).read_bytes(), mode=0o600)
            # All files are on disk before the database that needs them gets its name.
            os.sync()
        record = BackupRecord(
            version=__version__,
            made_at=made_at,
            database=name,
            store=copy.place if copy is store else "store",
            artifacts=backup.artifacts,
            bytes=backup.bytes,
        )
        write_durably(target / RECORD_NAME, record.model_dump_json(indent=2).encode() + b"\n")
    return backup


# ---- Database ------------------------------------------------------------------------------------


@contextmanager
def _copied_database(
    settings: Settings, target: Path, copies_bucket: bool
) -> Iterator[tuple[str, set[bytes]]]:
    """Copy the database; yield its name in the backup and the artifacts that it needs.

    The copy gets its name after the block.
    """
    store = open_store(settings.store_place)
    is_sqlite = settings.database_url is None
    name = settings.database_path.name if is_sqlite else DUMP_NAME
    scratch = target / f"{name}.new"
    for leftover in target.glob(f"{name}.new*"):
        leftover.unlink()
    if is_sqlite:
        _copy_sqlite(settings.database_path, scratch)
        with closing(SqliteDatabase(scratch)) as database:
            needed = _present(database, store, copies_bucket)
        yield name, needed
    else:
        # As another coordinator, this process keeps `rm` and `gc` away until it has ended.
        with closing(connect(settings, Role.coordinator)) as database:
            with database.write():
                pass
            needed = _present(database, store, copies_bucket)
            _dump_postgresql(settings, scratch)
            yield name, needed
    scratch.replace(target / name)


def _present(database: Database, store: Store, copies_bucket: bool) -> set[bytes]:
    """Return the digests in a database that are artifacts of a store that is copied.

    A digest in a task may also be that of something else. `scrub` looks for lost files.
    """
    if isinstance(store, DirectoryStore):
        needed = needed_artifacts(database, store)
        return {digest for digest in needed if store.exists(digest.hex())}
    if not copies_bucket:
        return set()
    # A bucket is listed in thousands; a question for each artifact would be a request.
    stored = {bytes.fromhex(file.name) for file in store.stored()}
    return needed_artifacts(database, store) & stored


def _copy_sqlite(path: Path, target: Path) -> None:
    """Copy a database that others may write to, in one read transaction."""
    target.touch(mode=0o600)
    with (
        closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=30)) as source,
        closing(sqlite3.connect(target)) as copy,
    ):
        source.backup(copy)


def _dump_postgresql(settings: Settings, target: Path) -> None:
    """Write a dump of the database with pg_dump.

    Raises CommandError if pg_dump is missing or refuses.
    """
    program = shutil.which("pg_dump")
    if program is None:
        raise CommandError("pg_dump is not installed: apt-get install postgresql-client")
    url = settings.database_url
    assert url is not None
    environment = dict(os.environ)
    # Other users of the machine can read the command line of a process.
    if url.password is not None:
        environment["PGPASSWORD"] = str(url.password)
    public_url = url.set(drivername="postgresql", password=None).render_as_string()
    target.touch(mode=0o600)
    command = [
        program,
        "--format=custom",
        "--no-owner",
        f"--file={target}",
        f"--dbname={public_url}",
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        raise CommandError(f"pg_dump has ended with {done.returncode}: {done.stderr.strip()[:500]}")


# ---- Store ---------------------------------------------------------------------------------------


def _copy_store(store: Store, target: Path, copies_bucket: bool) -> tuple[Backup, Store]:
    """Copy a store; return what was copied, and the copy.

    A bucket that is not copied is returned itself.
    """
    backup = Backup()
    copy = DirectoryStore(target / "store")
    if isinstance(store, DirectoryStore):
        _copy_directory(store, copy, backup)
    elif copies_bucket:
        _copy_bucket(store, copy, backup)
    else:
        return backup, store
    return backup, copy


def _copy_directory(store: DirectoryStore, copy: DirectoryStore, backup: Backup) -> None:
    # Versions show artifacts by hard links, which have the inode of the artifact.
    digests: dict[int, str] = {}
    for file in store.stored():
        if is_sha256(file.name):
            with suppress(FileNotFoundError):
                digests[store.path(file.name).stat().st_ino] = file.name
                _copy_artifact(store, copy, file.name, file.bytes, backup)
    _copy_versions(store, copy, digests)


def _copy_bucket(store: Store, copy: DirectoryStore, backup: Backup) -> None:
    """Download the artifacts and the files of versions that the copy lacks."""
    # What is shown was an artifact before, so the list of artifacts, which is made later, has it.
    version_files = set(store.version_files())
    for file in store.stored():
        with suppress(FileNotFoundError):
            _copy_artifact(store, copy, file.name, file.bytes, backup)
    for dataset, version in {(dataset, version) for dataset, version, _ in copy.version_files()}:
        if not any(name[:2] == (dataset, version) for name in version_files):
            copy.hide(dataset, version)
    # The files of a version never change, so those that the copy shows are not read again.
    for dataset, version, path in sorted(version_files - set(copy.version_files())):
        with suppress(FileNotFoundError):
            digest = sha256(store.read_shown(dataset, version, path))
            if copy.exists(digest):
                copy.show(digest, dataset, version, path)
            else:
                backup.damaged.append(digest)


def _copy_artifact(
    store: Store, copy: DirectoryStore, digest: str, size: int, backup: Backup
) -> None:
    if not copy.exists(digest) or copy.size(digest) != size:
        try:
            data = store.read(digest)
        except CorruptArtifactError:
            backup.damaged.append(digest)
            return
        path = copy.path(digest)
        path.parent.mkdir(parents=True, exist_ok=True)
        # One sync at the end waits for the disk, and not one for each of a million files.
        scratch = path.with_name(f".{digest}.backup.tmp")
        scratch.write_bytes(data)
        scratch.replace(path)
        backup.new_artifacts += 1
        backup.new_bytes += size
    backup.artifacts += 1
    backup.bytes += size


def _copy_versions(store: DirectoryStore, copy: DirectoryStore, digests: dict[int, str]) -> None:
    """Show the same files in the same versions, and hide versions that were removed."""
    source, target = (each.root / DATASETS for each in (store, copy))
    for path in target.glob("*/v*"):
        if VERSION.fullmatch(path.name) and not (source / path.relative_to(target)).is_dir():
            copy.hide(path.parent.name, int(path.name[1:]))
    for path in source.glob("*/v*/**/*"):
        dataset, version, *parts = path.relative_to(source).parts
        if not (VERSION.fullmatch(version) and path.is_file()):
            continue
        # A file system without hard links has the bytes of the file a second time.
        digest = digests.get(path.stat().st_ino) or sha256(path.read_bytes())
        if copy.exists(digest):
            copy.show(digest, dataset, int(version[1:]), "/".join(parts))


def _missing(copy: Store, needed: set[bytes], damaged: list[str]) -> list[str]:
    """Return the digests that the database needs and the copy lacks, without the damaged ones."""
    expected = needed - {bytes.fromhex(digest) for digest in damaged}
    return [digest.hex() for digest in sorted(expected) if not copy.exists(digest.hex())]
