"""Which code runs here: the digests that go into content keys."""

from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import stickslip_schemas
from stickslip_schemas.keys import content_key, sha256

import stickslip_workers

_SIMULATING = ("rods.py", "cloth.py", "records.py")
# What the stages call, and what that imports: a test follows the imports.
_FACE = (
    *("rods.py", "general_rods.py", "multistability.py", "rod_labels.py", "splines.py"),
    *("scenes.py", "cloth.py", "fabrics.py", "fabrics.toml", "meshes.py", "presets.py"),
)
_PACKING = ("pack.py", "publish.py", "metadata.py", "records.py")
_CONTRACT = ("chunks.py", "clips.py", "layout.py", "manifest.py")
_STAGES = Path(stickslip_workers.__file__).parent / "stages"
_LIBRARIES = ("zarr", "numcodecs", "google-crc32c")


def packer_build() -> str:
    """Return the digest of everything that decides on the bytes of a packed dataset."""
    contract = Path(stickslip_schemas.__file__).parent
    sources = [_STAGES / name for name in _PACKING] + [contract / name for name in _CONTRACT]
    libraries = {name: metadata.version(name) for name in _LIBRARIES}
    return content_key("packer", {"sources": _digests(sources), "libraries": libraries})


def sim_core_build() -> str:
    """Return the digest of everything that decides on a trajectory: the compiled core, its face, and our stage."""
    import stickslip_sim_core

    face = [Path(stickslip_sim_core.__file__).parent / name for name in _FACE]
    sources = {f"stage/{name}": digest for name, digest in _digests([_STAGES / name for name in _SIMULATING]).items()}
    core = str(stickslip_sim_core.build_info().build_hash)
    return content_key("sim_core", {"core": core, "sources": sources | _digests(face)})


def _digests(sources: Iterable[Path]) -> dict[str, str]:
    return {path.name: sha256(path.read_bytes()) for path in sources}


def versions() -> dict[str, str]:
    """Return versions for people."""
    names = ("stickslip-workers", "stickslip-schemas", "stickslip-sim-core", "ray", "zarr")
    return {name: metadata.version(name) for name in names}
