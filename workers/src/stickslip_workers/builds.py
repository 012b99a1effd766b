"""Which code runs here: the digests that go into content keys."""

from importlib import metadata
from pathlib import Path

import stickslip_schemas
from stickslip_schemas.keys import content_key, sha256

import stickslip_workers

_PACKING = ("pack.py", "publish.py", "metadata.py", "records.py")
_CONTRACT = ("chunks.py", "layout.py", "manifest.py")
_LIBRARIES = ("zarr", "numcodecs", "google-crc32c")


def packer_build() -> str:
    """Return the digest of everything that decides on the bytes of a packed dataset."""
    stages = Path(stickslip_workers.__file__).parent / "stages"
    contract = Path(stickslip_schemas.__file__).parent
    sources = [stages / name for name in _PACKING] + [contract / name for name in _CONTRACT]
    return content_key(
        "packer",
        {
            "sources": {path.name: sha256(path.read_bytes()) for path in sources},
            "libraries": {name: metadata.version(name) for name in _LIBRARIES},
        },
    )


def sim_core_build() -> str:
    """Return the digest of the simulation core: sources, compiler and settings."""
    from stickslip_sim_core import build_info

    return str(build_info().build_hash)


def versions() -> dict[str, str]:
    """Return versions for people."""
    names = ("stickslip-workers", "stickslip-schemas", "stickslip-sim-core", "ray", "zarr")
    return {name: metadata.version(name) for name in names}
