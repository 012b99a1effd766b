"""Builds: digests of the code of each kind and stage, for content keys.

A build covers the files that a stage imports (see `stickslip_schemas.plan.builds`) and the versions
of the libraries that the output depends on. If the stage uses the compiled core, the build covers
the core too.
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING

from stickslip_schemas.base import content_key
from stickslip_schemas.kinds import kind_named
from stickslip_schemas.plan.builds import UNCOUNTED, digests, sources

if TYPE_CHECKING:
    from stickslip_sim_core.scenes.kind import Kind


def scene_module(name: str) -> str:
    """Return the module that simulates a kind.

    Raises UnknownKindError for an unknown kind.
    """
    kind_named(name)
    return f"stickslip_sim_core.scenes.{name}"


def kind(name: str) -> "Kind":
    """Return the simulation of a kind.

    Raises UnknownKindError for an unknown kind.
    """
    simulated: Kind = import_module(scene_module(name)).KIND
    return simulated


_STAGES = "stickslip_workers.stages"
_LIBRARIES = ("zarr", "numcodecs", "google-crc32c")


def roots(stage: str, name: str) -> tuple[str, ...]:
    """Return the modules that a stage of a kind starts from.

    Raises ValueError for a stage other than `simulate` and `pack`.
    """
    if stage == "simulate":
        return (f"{_STAGES}.run", scene_module(name))
    if stage == "pack":
        return (
            f"{_STAGES}.run",
            f"{_STAGES}.pack",
            f"{_STAGES}.publish",
            f"stickslip_schemas.kinds.{name}",
        )
    raise ValueError(f"stage must be simulate or pack; got {stage!r}")


def build(stage: str, name: str) -> str:
    """Return the digest of all code that the output of a stage for a kind depends on."""
    libraries = (
        {library: metadata.version(library) for library in _LIBRARIES} if stage == "pack" else {}
    )
    core = "" if stage == "pack" else _core(kind(name).kernel())
    files = digests(sources(roots(stage, name), cut=UNCOUNTED))
    return content_key(
        f"build/{stage}", {"kind": name, "sources": files, "core": core, "libraries": libraries}
    )


def solver_build(module: str) -> str:
    """Return the digest of a solver.

    It covers a module of sim_core, everything that the module imports, and the compiled core. It
    does not cover the level of the kernels, because a certificate cannot see the difference between
    levels.
    """
    return content_key(
        "build/sim_core", {"core": _core(), "sources": digests(sources([module], cut=UNCOUNTED))}
    )


def kind_builds(name: str) -> dict[str, str]:
    """Return the builds of the stages that run in this interpreter."""
    return {"sim_core": solver_build(kind(name).solver)} | {
        stage: build(stage, name) for stage in ("simulate", "pack")
    }


def _core(kernel: str = "") -> str:
    from stickslip_sim_core import build_info

    return f"{build_info().build_hash} {kernel}"


def versions() -> dict[str, str]:
    """Return the versions of the main packages, by name."""
    names = ("stickslip-workers", "stickslip-schemas", "stickslip-sim-core", "ray", "zarr")
    return {name: metadata.version(name) for name in names}
