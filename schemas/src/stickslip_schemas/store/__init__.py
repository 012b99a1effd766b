"""The store of artifacts and dataset versions. Artifacts are atomic, and verified by digest."""

import re
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from stickslip_schemas.store.base import CorruptArtifactError, ShownVersion, Store, Stored, in_parallel, is_unavailable
from stickslip_schemas.store.directory import DirectoryStore, sync, write_durably

__all__ = [
    "CorruptArtifactError",
    "DirectoryStore",
    "ShownVersion",
    "Store",
    "Stored",
    "in_parallel",
    "is_unavailable",
    "open_store",
    "store_place",
    "sync",
    "write_durably",
]

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
"""How a URL begins, also one with too few slashes: `s3:/bucket` is no directory."""


def store_place(place: str | Path) -> str:
    """Return the place of a store as every process of a machine understands it, a path or a URL; raise ValueError."""
    text = str(place)
    if _SCHEME.match(text) is None and text:
        return str(Path(text).absolute())
    try:
        url = urlsplit(text)
    except ValueError:
        url = urlsplit("")
    if text.startswith("file://") and url.netloc in ("", "localhost") and url.path.startswith("/"):
        return str(Path(unquote(url.path)))
    if (
        text.startswith("s3://")
        and re.fullmatch(r"[a-z0-9][a-z0-9.-]*", url.netloc)
        and not (url.query or url.fragment)
    ):
        return f"s3://{url.netloc}/{quote(unquote(url.path).strip('/'))}".rstrip("/")
    raise ValueError(
        f"store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got {text!r}. "
        "Write ./NAME for a directory whose name has a colon."
    )


def open_store(place: str | Path) -> Store:
    """Open the store at a place; see `store_place`. Nothing is written, and no server is asked.

    Raises ValueError where there is no such sort of store, or what it needs is not installed.
    """
    place = store_place(place)
    if not place.startswith("s3://"):
        return DirectoryStore(place)
    try:
        from stickslip_schemas.store.bucket import BucketStore
    except ModuleNotFoundError as error:
        raise ValueError(
            f"the store {place} needs obstore, which is not installed: pip install 'stickslip-schemas[s3]'"
        ) from error
    url = urlsplit(place)
    return BucketStore(url.netloc, unquote(url.path).strip("/"))
