"""The common part of the adapters of Newton's solvers: bodies, held vertices, steps."""

from typing import Any

import newton
import numpy as np
import warp as wp

RADIUS = 1e-3  # of a particle [m]


class Sheets:
    """Sheets of cloth on one of the solvers, which a subclass chooses."""

    version = newton.__version__
    capabilities = frozenset({"held", "floor", "planes", "cylinders", "sheets", "curved"})
    clearance = RADIUS
    gap = 2.0 * RADIUS
    frame = 1.0 / 60.0
    substeps = 1
    graph: Any = None
    add_sheets: Any
    solver_of: Any
    rate = 0.0

    def __init__(self, scene: Any, setting: str) -> None:
        builder = self.builder()
        for body in scene.bodies:
            add_body(builder, body, scene.friction or body.friction)
        self.add_sheets(
            builder,
            scene,
            pos=wp.vec3(),
            rot=wp.quat_identity(),
            vel=wp.vec3(),
            scale=1.0,
            indices=scene.triangles.ravel().tolist(),
            density=scene.density,
            particle_radius=RADIUS,
        )
        self.model = builder.finalize(device="cpu")
        frictions = [scene.friction or 0.0, *(body.friction for body in scene.bodies)]
        self.model.soft_contact_mu = scene.friction or max(frictions)
        self.model.particle_q.assign(scene.start)
        flags = self.model.particle_flags.numpy()
        flags[scene.held] &= ~int(newton.ParticleFlags.ACTIVE)
        self.model.particle_flags.assign(flags)
        inverse = self.model.particle_inv_mass.numpy()
        inverse[scene.held] = 0.0
        self.model.particle_inv_mass.assign(inverse)
        self.solver = self.solver_of(scene, setting)
        self.pipeline = newton.CollisionPipeline(self.model)
        self.contacts = self.pipeline.contacts()
        self.states = [self.model.state(), self.model.state()]
        self.set_gravity(scene.gravity)

    builder = newton.ModelBuilder

    def frame_of_substeps(self) -> None:
        """Advance by a frame."""
        for _ in range(self.substeps):
            self.pipeline.collide(self.states[0], self.contacts)
            self.states[0].clear_forces()
            self.solver.step(*self.states, None, self.contacts, self.frame / self.substeps)
            self.states.reverse()

    def step(self) -> None:
        """Advance by a frame; a graph of the launches is recorded after the first one."""
        if self.graph is not None:
            wp.capture_launch(self.graph)
        else:
            self.frame_of_substeps()
            self.graph = self.record()
        speeds = self.states[0].particle_qd
        speeds.assign(speeds.numpy() * np.exp(-self.rate * self.frame))

    def record(self) -> Any:
        """Return the launches of a frame, which then need no Python."""
        with wp.ScopedCapture(device="cpu") as capture:
            self.frame_of_substeps()
        return capture.graph

    def positions(self) -> Any:
        """Return the vertices."""
        return self.states[0].particle_q.numpy()

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity."""
        self.model.set_gravity(np.asarray(gravity))

    def damp(self, rate: float) -> None:
        """Change the decay of velocities."""
        self.rate = rate


def add_body(builder: Any, body: Any, cloth: float) -> None:
    """Add a body. A contact has the root of the product of both frictions."""
    shape = newton.ModelBuilder.ShapeConfig(mu=body.friction**2 / cloth)
    axis = wp.vec3(*body.direction)
    place = wp.transform(
        wp.vec3(*body.point), wp.quat_between_vectors(wp.vec3(0.0, 0.0, 1.0), axis)
    )
    if body.kind == "plane":
        builder.add_shape_plane(xform=place, width=0.0, length=0.0, cfg=shape)
    else:
        builder.add_shape_cylinder(-1, xform=place, radius=body.radius, half_height=1.0, cfg=shape)
