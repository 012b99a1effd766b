"""The adapter of Newton's vertex block descent: elastic triangles, and hinges at edges."""

from typing import Any, ClassVar

import newton
import warp as wp
from _newton import Sheets

SOURCE = "https://newton-physics.github.io/newton/latest/api/newton_solvers.html"

SOLVERS = {
    "default": {"iterations": 10, "friction_epsilon": 1e-2},
    "tuned": {"iterations": 100, "friction_epsilon": 1e-4},
}

CHOICES = {
    "step": "1/60 s",
    "substeps": 10,
    "damping of triangles and edges": "0, since a scene has none (Newton's defaults have some)",
    "stretching": "tri_ke = Y/2, tri_ka = 0",
    "bending": "edge_ke = D over the length of a cell",
    "particle radius": "1 mm",
    "friction": "contacts take the root of the product, so bodies have mu^2 over that of cloth",
}


class Simulator(Sheets):
    """Sheets of cloth."""

    name = "newton-vbd"
    substeps = 10
    settings: ClassVar = {
        "default": {**SOLVERS["default"], **CHOICES},
        "tuned": {**SOLVERS["tuned"], **CHOICES, "source": SOURCE},
    }

    def add_sheets(self, builder: Any, scene: Any, **sheets: Any) -> None:
        """Add all sheets in their flat shape; an edge has the stiffness `edge_ke` times length."""
        stiffness = {"tri_ke": scene.stretching / 2.0, "edge_ke": scene.bending / scene.cell}
        # A scene has no damping of its material, and Newton has by default.
        undamped = {"tri_ka": 0.0, "tri_kd": 0.0, "edge_kd": 0.0}
        points = [wp.vec3(*point) for point in scene.flat()]
        builder.add_cloth_mesh(vertices=points, **stiffness, **undamped, **sheets)
        builder.color(include_bending=True)

    def solver_of(self, scene: Any, setting: str) -> Any:
        """Return the solver."""
        touch = {"particle_self_contact_margin": self.gap, "particle_self_contact_gap": self.gap}
        touch["particle_enable_self_contact"] = scene.friction is not None
        return newton.solvers.SolverVBD(self.model, **touch, **SOLVERS[setting])
