"""The store of artifacts and dataset versions. Artifacts are atomic, and verified by digest."""

from stickslip_schemas.store.base import (
    CorruptArtifactError,
    Room,
    ShownVersion,
    Span,
    Store,
    Stored,
    artifact_name,
    in_parallel,
    is_unavailable,
    shown_name,
    version_name,
)
from stickslip_schemas.store.directory import DirectoryStore, sync, write_durably
from stickslip_schemas.store.opening import open_store, store_place

__all__ = [
    "CorruptArtifactError",
    "DirectoryStore",
    "Room",
    "ShownVersion",
    "Span",
    "Store",
    "Stored",
    "artifact_name",
    "in_parallel",
    "is_unavailable",
    "open_store",
    "shown_name",
    "store_place",
    "sync",
    "version_name",
    "write_durably",
]
