"""Opening a store by its URL."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from stickslip_schemas.store.base import Store
from stickslip_schemas.store.directory import DirectoryStore


def open_store(place: str | Path) -> Store:
    """Open the store at a path, or at a URL `file:///DIRECTORY`; raise ValueError for another one."""
    if isinstance(place, Path) or "://" not in place:
        return DirectoryStore(place)
    url = urlsplit(place)
    if url.scheme == "file" and url.netloc in ("", "localhost") and url.path.startswith("/"):
        return DirectoryStore(unquote(url.path))
    raise ValueError(f"store must be a directory or file:///DIRECTORY; got {place!r}")
