"""How much memory a call needs, which Ray counts where it places calls. The numbers come from measured peaks."""

from stickslip_schemas.base.states import Stage
from stickslip_schemas.documents.tasks import SimulateTask

from stickslip_workers.batches import Parts

MIB = 2**20

STAGE_BYTES = {Stage.simulate: 256 * MIB, Stage.render: 1024 * MIB, Stage.pack: 512 * MIB, Stage.publish: 512 * MIB}
"""Of a process without a mesh [bytes]. Measured: 152 MiB after 512 rods."""

VERTEX_BYTES = 96 * 1024
"""For each vertex of a mesh [bytes]. Measured: 60 kB with 81 x 81 and 161 x 161 vertices; contacts need more."""


def memory_bytes(stage: Stage, parts: Parts) -> int:
    """Return what to ask Ray for."""
    tasks = [lease.task for part in parts for lease in part]
    vertices = [task.simulation.vertices for task in tasks if isinstance(task, SimulateTask)]
    return STAGE_BYTES[stage] + VERTEX_BYTES * max(vertices, default=0)
