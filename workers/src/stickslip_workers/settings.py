"""Settings of a dispatcher."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

from stickslip_schemas.base import Stage

RENDER_ACTOR = "stickslip_blender.actor:RenderActor"
RENDER_DEVICE = "STICKSLIP_RENDER_DEVICE"
"""Environment variable with the render device."""

CPU = "cpu"
"""The render device that is used if the variable is not set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Options of a dispatcher.

    Times are in seconds.
    """

    urls: tuple[str, ...]
    """Base URLs of coordinators with one database.

    If one does not answer, the dispatcher asks the next one.
    """
    store: str
    """Place of the store, see `store_place`. A directory is the same on every node."""
    name: str
    """Name of this dispatcher. A second dispatcher with the same name replaces the first one."""
    key_file: Path | None = None
    """File with the key of the worker API, or None if the coordinator wants no key.

    The dispatcher reads it again when the key is refused.
    """
    tls_certificate: Path | None = None
    """Certificate of the coordinator.

    The dispatcher trusts exactly this certificate. None stands for the usual check of certificates.
    """
    max_cpus: int | None = None
    """The most CPUs of the Ray cluster to use at once.

    By default, the dispatcher uses all CPUs, and submits more calls so that the cluster may grow.
    """

    blender_python: Path = field(default_factory=lambda: default_blender_python())
    render_device: str = field(default_factory=lambda: os.environ.get(RENDER_DEVICE) or CPU)
    """Device of Cycles: `cpu`, or a sort of GPU."""
    render_gpus: float = 1.0
    """GPUs of Ray that a render process takes if it computes on a GPU.

    Fractions share a GPU.
    """
    render_actor: str = RENDER_ACTOR
    """Class in the Blender interpreter, with the methods `describe` and `render`.

    Its constructor takes the root of the store.
    """

    exec_seconds: dict[Stage, float] = field(
        default_factory=lambda: {
            Stage.simulate: 6 * 3600,
            Stage.render: 1800,
            Stage.pack: 600,
            Stage.publish: 3600,
        }
    )
    """Limit of one task, or batch of simulations, by stage.

    After the limit, the process is killed. Cloth takes minutes, and hours with the thesis's time
    steps.
    """
    clog_seconds: float = 10
    """If calls occupy all CPUs for longer than this, shorter tasks run beside them."""
    start_seconds: float = 120
    """Wait of a call for its start, with CPUs free, before the coordinator gets a report."""
    stop_seconds: float = 8
    """Time that running work may continue after SIGTERM."""


def default_blender_python() -> Path:
    """Return the interpreter of the Blender environment beside the running environment."""
    return Path(sys.prefix).parent / ".venv-blender" / "bin" / "python"
