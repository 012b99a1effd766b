"""Opening a store by its URL."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from stickslip_schemas.store.base import Store
from stickslip_schemas.store.directory import DirectoryStore


def open_store(place: str | Path) -> Store:
    """Open the store at a path, or at a URL `file:///DIRECTORY` or `s3://BUCKET/PREFIX`.

    Raises:
        ValueError: It is another URL.
        ModuleNotFoundError: A store in a bucket needs `pip install 'stickslip-schemas[s3]'`.
    """
    if isinstance(place, Path) or "://" not in place:
        return DirectoryStore(place)
    url = urlsplit(place)
    if url.scheme == "file" and url.netloc in ("", "localhost") and url.path.startswith("/"):
        return DirectoryStore(unquote(url.path))
    if url.scheme == "s3" and url.netloc and not (url.query or url.fragment or "@" in url.netloc):
        from stickslip_schemas.store.bucket import BucketStore

        return BucketStore(url.netloc, unquote(url.path).strip("/"))
    raise ValueError(f"store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got {place!r}")
