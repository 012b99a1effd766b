"""Settings of a dispatcher."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

from stickslip_schemas.base import Stage

RENDER_ACTOR = "stickslip_blender.actor:RenderActor"
RENDER_DEVICE, CPU = "STICKSLIP_RENDER_DEVICE", "cpu"
"""Environment variable with the render device, and its default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Options of a dispatcher. Times are in seconds."""

    urls: tuple[str, ...]
    """Base URLs of coordinators with one database: the next one is asked where one does not answer.
    """
    store: str
    """Place of the store, see `store_place`. A directory is the same on every node."""
    name: str
    """Name of this dispatcher; a second one of the same name takes the first one's place."""
    key: str | None = None
    """What the coordinator wants to be shown by workers; None if it wants nothing."""
    tls_certificate: Path | None = None
    """Certificate of the coordinator, trusted by itself; None: the usual check of certificates."""
    max_cpus: int | None = None
    """The most CPUs of the Ray cluster to use at once; by default as many as there are, and what it
    may grow by.
    """

    blender_python: Path = field(default_factory=lambda: default_blender_python())
    render_device: str = field(default_factory=lambda: os.environ.get(RENDER_DEVICE) or CPU)
    """What Cycles computes on: `cpu`, or a sort of GPU."""
    render_gpus: float = 1.0
    """GPUs that a render process takes of those of Ray, where it computes on one; fractions share a
    GPU.
    """
    render_actor: str = RENDER_ACTOR
    """Class, in the Blender interpreter, that is made with the root of the store and has `describe`
    and `render`.
    """

    exec_seconds: dict[Stage, float] = field(
        default_factory=lambda: {
            Stage.simulate: 6 * 3600,
            Stage.render: 1800,
            Stage.pack: 600,
            Stage.publish: 3600,
        }
    )
    """Limit of one task, or batch of simulations, by stage; then its process is killed. Cloth takes
    minutes, and hours with the thesis's time steps."""
    clog_seconds: float = 10
    """With all CPUs taken for longer than this, tasks that take less go on beside them."""
    start_seconds: float = 120
    """The coordinator hears of a call that Ray has not started for longer, with CPUs free."""
    stop_seconds: float = 8
    """How long running work may go on after SIGTERM."""


def default_blender_python() -> Path:
    """Return the interpreter of the Blender environment beside the running one."""
    return Path(sys.prefix).parent / ".venv-blender" / "bin" / "python"
