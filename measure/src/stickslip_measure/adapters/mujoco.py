"""The adapter of MuJoCo: a sheet is a flex whose Young's modulus and thickness give Y and D."""

from itertools import pairwise
from typing import Any, ClassVar

import mujoco
import numpy as np

RADIUS = 1e-3  # m
OPTIONS = {
    "default": 'integrator="discrete"',
    "tuned": 'integrator="discrete" cone="elliptic" impratio="100" tolerance="1e-10"',
}
CONTACTS = {"default": "", "tuned": 'solref="0.004 1" solimp="0.99 0.999 0.0001"'}


class Simulator:
    """Sheets of cloth."""

    name = "mujoco"
    version = mujoco.__version__
    capabilities = frozenset({"held", "floor", "planes", "cylinders", "sheets", "curved"})
    clearance = RADIUS
    gap = 2.0 * RADIUS
    settings: ClassVar = {
        "default": {"options": OPTIONS["default"], "flexcomp": "Y, D by young, thickness"},
        "tuned": {
            "options": f"{OPTIONS['tuned']} {CONTACTS['tuned']}",
            "flexcomp": "Y, D by young, thickness; masses by area",
            "source": "https://mujoco.readthedocs.io/en/stable/modeling.html#contact-parameters",
        },
    }

    def __init__(self, scene: Any, setting: str) -> None:
        self.scene = scene
        self.contact = CONTACTS[setting]
        self.rate = 0.0
        # A flex rests in the shape that it is made with, so one that starts bent is moved. Pins
        # cannot be moved.
        bent = scene.is_curved() and not len(scene.held)
        points = scene.flat() if bent else scene.start
        first = np.flatnonzero(np.diff(scene.sheet, prepend=-1, append=-1))
        flexes = [self.flex(points, slice(*ends)) for ends in pairwise(first)]
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option gravity="{text(scene.gravity)}" {OPTIONS[setting]}/>'
            f'<size memory="400M"/><worldbody>{"".join(map(self.geom, scene.bodies))}'
            f'<body name="cloth">{"".join(flexes)}</body></worldbody></mujoco>'
        )
        self.data = mujoco.MjData(self.model)
        self.frame = self.model.opt.timestep
        if setting == "tuned":
            free = np.setdiff1d(np.arange(len(points)), scene.held)
            self.model.body_mass[self.model.flex_vertbodyid[free]] = scene.masses()[free]
            mujoco.mj_setConst(self.model, self.data)
        if bent:
            self.data.qpos[:] = (scene.start - points).ravel()
        mujoco.mj_forward(self.model, self.data)

    def geom(self, body: Any) -> str:
        """Return a body as XML; its friction has priority over that of the sheets."""
        size = "1 1 0.1" if body.kind == "plane" else f"{body.radius} 1"
        return (
            f'<geom type="{body.kind}" size="{size}" pos="{text(body.point)}" priority="1" '
            f'zaxis="{text(body.direction)}" friction="{body.friction} 0 0" {self.contact}/>'
        )

    def flex(self, points: Any, part: slice) -> str:
        """Return a sheet as XML."""
        scene = self.scene
        triangles = scene.triangles[scene.sheet[scene.triangles[:, 0]] == scene.sheet[part.start]]
        thickness = np.sqrt(12.0 * (1.0 - scene.poisson**2) * scene.bending / scene.stretching)
        pins = [v - part.start for v in scene.held if part.start <= v < part.stop]
        touch = int(bool(scene.bodies) or scene.friction is not None)
        return (
            f'<flexcomp name="sheet{part.start}" type="direct" dim="2" radius="{RADIUS}" '
            f'mass="{scene.masses()[part].sum()}" point="{text(points[part].ravel())}" '
            f'element="{text((triangles - part.start).ravel())}">'
            f'<elasticity young="{scene.stretching / thickness}" poisson="{scene.poisson}" '
            f'thickness="{thickness}" elastic2d="both"/>'
            f'<contact contype="{touch}" conaffinity="{touch}" selfcollide="none" '
            f'friction="{scene.friction or 0.0} 0 0" {self.contact}/>'
            f"{f'<pin id={text(pins)!r}/>' if pins else ''}</flexcomp>"
        )

    def step(self) -> None:
        """Advance by a time step."""
        self.data.qvel *= np.exp(-self.rate * self.frame)
        mujoco.mj_step(self.model, self.data)

    def positions(self) -> Any:
        """Return the vertices of all flexes."""
        return self.data.flexvert_xpos

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity."""
        self.model.opt.gravity[:] = gravity

    def damp(self, rate: float) -> None:
        """Change the decay of velocities."""
        self.rate = rate


def text(numbers: Any) -> str:
    """Return numbers as XML has them."""
    return " ".join(f"{number:.12g}" for number in numbers)
