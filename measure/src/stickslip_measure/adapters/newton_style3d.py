"""The adapter of Newton's Style3D solver: panels with their own directions of the weave."""

from typing import Any, ClassVar

import newton
import warp as wp
from _newton import Sheets
from newton.solvers import SolverStyle3D, style3d

SOURCE = "https://newton-physics.github.io/newton/latest/api/newton_solvers.html"

ITERATIONS = {"default": 10, "tuned": 100}
EPSILON = {"default": 1e-2, "tuned": 1e-4}

CHOICES = {
    "step": "1/60 s",
    "substeps": 2,
    "damping": "0: Style3D has none of its own, and none is added",
    "stretching": "tri_aniso_ke = Y, Y, Y/2 (warp, weft, shear)",
    "bending": "edge_aniso_ke = D",
    "particle radius": "1 mm",
    "friction": "contacts take the root of the product, so bodies have mu^2 over that of cloth",
}


class Simulator(Sheets):
    """Sheets of cloth. Sheets push each other away, and have no friction with each other."""

    name = "newton-style3d"
    capabilities = frozenset({"held", "floor", "planes", "cylinders", "curved"})
    substeps = 2
    settings: ClassVar = {
        "default": {"iterations": 10, "friction_epsilon": 1e-2, **CHOICES},
        "tuned": {"iterations": 100, "friction_epsilon": 1e-4, **CHOICES, "source": SOURCE},
    }

    def builder(self) -> Any:
        """Return an empty model."""
        builder = newton.ModelBuilder()
        SolverStyle3D.register_custom_attributes(builder)
        return builder

    def add_sheets(self, builder: Any, scene: Any, **sheets: Any) -> None:
        """Add all sheets: stretching along warp and weft, shear, and bending."""
        style3d.add_cloth_mesh(
            builder,
            vertices=[wp.vec3(*point) for point in scene.start],
            panel_verts=[wp.vec2(*point) for point in scene.rest],
            panel_indices=sheets["indices"],
            tri_aniso_ke=wp.vec3(scene.stretching, scene.stretching, scene.stretching / 2.0),
            edge_aniso_ke=wp.vec3(scene.bending),
            **sheets,
        )

    def solver_of(self, scene: Any, setting: str) -> Any:
        """Return the solver."""
        config = SolverStyle3D.Config(iterations=ITERATIONS[setting])
        solver = SolverStyle3D(self.model, config=config)
        solver.collision.friction_epsilon = EPSILON[setting]
        return solver

    def record(self) -> Any:
        """Return no graph: the solver computes in Python, too."""
        return None
