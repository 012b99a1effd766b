"""An export is there whole or not at all, and overwrites nothing."""

import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from stickslip_schemas.store import sync

from stickslip_training.export.content import DESCRIPTION, MANIFEST_COPY, Content, OnBytes


def to_directory(
    content: Content, target: Path, on_bytes: OnBytes, write: Callable[[Content, Path, OnBytes], None]
) -> None:
    """Let `write` fill a directory, and add the manifest and a description."""
    with made_whole(target) as scratch:
        scratch.mkdir()
        (scratch / MANIFEST_COPY).write_bytes(content.manifest())
        (scratch / DESCRIPTION).write_bytes(content.description())
        write(content, scratch, on_bytes)


@contextmanager
def made_whole(target: Path) -> Iterator[Path]:
    """Give a path beside `target` to write to, which becomes `target` at the end, or vanishes after an error.

    Raises FileExistsError, and overwrites nothing, where `target` exists.
    """
    _refuse_existing(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")
    try:
        yield scratch
        for path in [scratch, *scratch.rglob("*")]:
            sync(path)
        _refuse_existing(target)
        scratch.rename(target)
        sync(target.parent)
    finally:
        if scratch.is_dir():
            shutil.rmtree(scratch)
        else:
            scratch.unlink(missing_ok=True)


def _refuse_existing(target: Path) -> None:
    if os.path.lexists(target):
        raise FileExistsError(f"{target} exists, and an export overwrites nothing: name another place")
