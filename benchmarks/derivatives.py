"""Derivatives of runs of cloth against central differences of runs with the same steps.

    python benchmarks/derivatives.py [CASE ...] [--changes 1e-4 1e-5] [--out RECORD]
    python benchmarks/derivatives.py --cost MESH

Each case is a scene and a parameter p. A first run chooses the ends of all steps, and further runs
at p - h, p and p + h repeat them, with tolerance 1e-8. At each frame the error is that of the
difference of positions, |difference - derivative| over |derivative|, over all vertices. `h` is over
the size of p. A difference is wrong where a contact changes its branch between p - h and p + h, so
that the median over the frames is quoted, besides the worst frame.

Without CASE all run but those of `SLOW`. With `--cost`, a whole drag of that mesh runs without
derivatives, by one parameter and by three, and the CPU times are compared.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface, plane, sphere
from stickslip_sim_core.cloth.fabrics import fabric, isotropic
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter
from stickslip_sim_core.scenes.holders import Hang, Holder
from stickslip_sim_core.scenes.scene import Scene

CHANGES = (1e-4, 1e-5, 1e-6)
"""Changes h of a parameter, over its size."""

TOLERANCE = 1e-8
"""Of the steps that are repeated: a difference over 2 h has the error of positions over h."""

SLOPE = np.deg2rad(25.0)

# Of second order a run jumps where a vertex lands or leaves, and no difference converges.
CHOOSING = replace(preset_named("certified"), second_order=False)
"""Settings of the run that chooses the steps."""

UNMOVED = 1e-9
"""Root mean square of a derivative below which a frame does not depend on a parameter [m]."""

Make = Callable[[Mapping[str, float], SolverSettings, Hang], Scene]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A scene and the parameter by which its run is differentiated."""

    make: Make
    parameter: SceneParameter
    name: str = "mu"
    ends: Sequence[float] | None = None
    """Ends of the steps [s]. None: those that the run at p chooses."""

    def family(self, settings: SolverSettings) -> SceneFamily:
        return SceneFamily(
            {self.name: self.parameter}, lambda values, hang: self.make(values, settings, hang)
        )


def even(step: float, count: int) -> list[float]:
    return [step * (number + 1) for number in range(count)]


def flat(mesh: meshes.Mesh, height: float = 0.0) -> Floats:
    return np.column_stack([mesh.rest, np.full(len(mesh.rest), height)])


def incline(values: Mapping[str, float], settings: SolverSettings, _hang: Hang) -> Scene:
    mesh = meshes.grid(0.1, 0.1, 8, 8)
    down = GRAVITY * np.array([np.sin(SLOPE), 0.0, -np.cos(SLOPE)])
    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=settings,
        start=flat(mesh),
        motion=lambda _time: (np.tile(down, (len(mesh.rest), 1)), [plane(values["mu"])]),
        frames=9,
        frame_rate=20.0,
    )


def cantilever(damping: float) -> Make:
    """Return a strip of 10 cm that is held at one end, with Gamma = rho g L^3/D = 30."""

    def make(values: Mapping[str, float], settings: SolverSettings, _hang: Hang) -> Scene:
        length, density = 0.1, 0.2
        weight = density * GRAVITY * length
        mesh = meshes.grid(length, 0.02, 20, 2)
        x = mesh.rest[:, 0] - mesh.rest[:, 0].min()
        held = np.flatnonzero(x < 1.5 * length / 20)
        strip = isotropic(density, 3e3 * weight, weight * length**2 / 30.0)
        return Scene(
            mesh=mesh,
            fabrics=[strip.scaled(bending=values["bending"])],
            preset=settings,
            start=flat(mesh),
            motion=lambda _time: (np.tile([0.0, 0.0, -GRAVITY], (len(x), 1)), []),
            holders=[Holder(held, at_rest)],
            damping=lambda _time: damping,
            frames=11,
            frame_rate=20.0,
        )

    return make


def at_rest(_time: Any) -> Floats:
    return np.eye(3, 4)


def on_ball(values: Mapping[str, float], settings: SolverSettings, _hang: Hang) -> Scene:
    """A sheet lies on a ball, 20 degrees off its top, and slides down."""
    mesh, radius, lean = meshes.grid(0.1, 0.1, 12, 12), 0.3, np.deg2rad(20.0)
    far = np.linalg.norm(mesh.rest, axis=1) + 1e-12
    around = np.column_stack(
        [mesh.rest * (np.sin(far / radius) / far)[:, None], np.cos(far / radius)]
    )
    c, s = np.cos(lean), np.sin(lean)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=settings,
        # The tilt of the ground must not put a vertex inside the ball by rounding.
        start=(radius + 1e-9) * around @ turn.T,
        motion=lambda _time: (
            np.tile([0.0, 0.0, -GRAVITY], (len(far), 1)),
            [sphere(values["mu"], radius)],
        ),
        damping=lambda _time: 2.0,
        frames=9,
        frame_rate=20.0,
    )


def drag(mesh: int, frames: int, material: str = "gray-interlock", **more: Any) -> Make:
    """Return a drag of the dataset; `more` are other arguments of `Drag`."""

    def make(values: Mapping[str, float], settings: SolverSettings, hang: Hang) -> Scene:
        arguments = {"self_friction": None, "mu": 0.3, **more}
        factors = {name: value for name, value in values.items() if name in ("bending", "density")}
        arguments |= {name: values[name] for name in ("mu", "speed") if name in values}
        return cloth_drag.Drag(
            fabric=fabric(material).scaled(**factors),
            mesh=meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, mesh - 1, mesh - 1),
            preset=settings,
            frames=frames,
            **arguments,
        ).scene(hang)

    return make


def two_sheets(values: Mapping[str, float], settings: SolverSettings, _hang: Hang) -> Scene:
    """A sheet slides over a larger one, which is held."""
    lower, upper = meshes.grid(0.08, 0.08, 6, 6), meshes.grid(0.05, 0.05, 5, 5)
    count = len(lower.rest)
    down = np.array([0.9 * np.sin(SLOPE), 0.3 * np.sin(SLOPE), -np.cos(SLOPE)])
    plan = np.vstack([lower.rest, upper.rest + 7e-4])
    height = np.append(np.zeros(count), np.full(len(upper.rest), 5e-4))
    return Scene(
        mesh=meshes.together(lower, upper),
        fabrics=[fabric("gray-interlock")] * 2,
        preset=settings,
        start=np.column_stack([plan, height]),
        motion=lambda _time: (np.tile(GRAVITY * down, (len(plan), 1)), []),
        holders=[Holder(np.arange(count), at_rest)],
        self_contact=SelfContact(mu=values["mu"], thickness=5e-4, bearing="first"),
        frames=11,
        frame_rate=100.0,
    )


def on_hill(values: Mapping[str, float], settings: SolverSettings, _hang: Hang) -> Scene:
    """A strip that is held at one end comes down on a smooth mound of triangles."""
    mesh = meshes.grid(0.1, 0.04, 10, 4)
    held = np.flatnonzero(mesh.rest[:, 0] < mesh.rest[:, 0].min() + 0.011)
    ground = meshes.grid(0.2, 0.12, 12, 8)
    mound = np.exp(-((ground.rest[:, 0] / 0.05) ** 2))
    points = np.column_stack([ground.rest, 0.012 * mound - 0.005])
    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=settings,
        start=flat(mesh, 0.02),
        motion=lambda _time: (np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1)), []),
        holders=[Holder(held, at_rest)],
        surfaces=[Surface(ground.triangles, lambda _time: points, mu=values["mu"])],
        frames=9,
        frame_rate=20.0,
    )


def grasps(values: Mapping[str, float], settings: SolverSettings, _hang: Hang) -> Scene:
    """A holder lets a napkin go over a ball and a table; another one grasps and lifts it."""
    mesh = meshes.grid(0.1, 0.06, 10, 6)
    x = mesh.rest[:, 0]
    # The lift begins before the grasp, with a speed that does not jump.
    lift = values.get("lift", 0.02)

    def lifted(at: Any) -> Floats:
        pose = np.zeros((*np.shape(at), 3, 4))
        pose[..., :3] = np.eye(3)
        share = np.minimum(np.asarray(at, float) / 0.5, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        pose[..., 0, 3], pose[..., 2, 3] = 0.05 * smooth, lift * smooth
        return pose

    bodies: list[Body] = [
        sphere(0.4, 0.02, origin=(0.0, 0.0, -0.012)),
        plane(0.4, origin=(0.0, 0.0, -0.005)),
    ]
    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=settings,
        start=flat(mesh, 0.01),
        # A lean keeps rounding from choosing the side to which the napkin falls.
        motion=lambda _time: (np.tile([0.3, 0.2, -GRAVITY], (len(x), 1)), bodies),
        holders=[
            Holder(np.flatnonzero(x == x.min()), at_rest, (0.0, 0.15)),
            Holder(np.flatnonzero(x == x.max()), lifted, (0.1, 0.4)),
        ],
        frames=7,
        frame_rate=20.0,
    )


def growing(first: float, growth: float, longest: float, settled: int, count: int) -> list[float]:
    """Return ends of steps that grow after a number of them."""
    steps = [first] * settled
    while len(steps) < count:
        steps.append(min(growth * steps[-1], longest))
    return [float(end) for end in np.cumsum(steps)]


MU = SceneParameter(0.3, 0.0, 2.0)
FACTOR = SceneParameter(1.0, 0.1, 10.0)
SLIDING = SceneParameter(0.2, 0.0, 2.0)

CASES: dict[str, Case] = {
    "incline": Case(make=incline, parameter=SLIDING, ends=even(0.01, 40)),
    "cantilever at rest": Case(
        make=cantilever(3.0),
        name="bending",
        parameter=FACTOR,
        ends=growing(0.02, 1.2, 1.0, 60, 120),
    ),
    "cantilever swinging": Case(
        make=cantilever(0.0), name="bending", parameter=FACTOR, ends=even(0.02, 25)
    ),
    "ball": Case(make=on_ball, parameter=SceneParameter(0.15, 0.0, 2.0), ends=even(0.01, 40)),
    "drag 11": Case(make=drag(11, 80), parameter=MU),
    "drag 11, bending": Case(make=drag(11, 80), name="bending", parameter=FACTOR),
    "drag 11, speed": Case(make=drag(11, 80), name="speed", parameter=FACTOR),
    "drag 21": Case(make=drag(21, 60), parameter=MU),
    "drag 21, bending": Case(make=drag(21, 60), name="bending", parameter=FACTOR),
    "drag 41": Case(make=drag(41, 60), parameter=MU),
    "two sheets": Case(make=two_sheets, parameter=SLIDING, ends=even(0.01, 10)),
    "mesh body": Case(make=on_hill, parameter=SLIDING, ends=even(0.01, 40)),
    "self-contact": Case(
        make=drag(21, 80, "camel-ponte-roma", self_friction=0.5),
        parameter=SceneParameter(1.0, 0.0, 2.0),
    ),
    "fabric that stiffens": Case(
        make=drag(11, 60, "navy-sparkle-sweat"), name="bending", parameter=FACTOR
    ),
    "grasp": Case(
        make=grasps, name="lift", parameter=SceneParameter(0.02, 0.0, 0.1), ends=even(0.005, 60)
    ),
}

SLOW = ("drag 41",)


class Repeated(NamedTuple):
    """A run with given ends of steps, at the first of them in each frame."""

    times: Floats
    """(F,) [s]"""
    positions: Floats
    """(F, V, 3) [m]"""
    derivatives: Floats
    """By the parameter, if the scene is differentiated: (F, V, 3) [m per unit]."""
    unrefined: int


def repeated(scene: Scene, ends: Sequence[float]) -> Repeated:
    """Run a scene with given ends of steps, and record the first end in each frame."""
    hands, cloth, followed = scene.begin()
    times: list[float] = []
    positions, derivatives = [], []
    frame = 1
    for number, end in enumerate(ends):
        # Steps of equal length end beside the time of an event by rounding.
        if any(abs(cloth.time - event) < 1e-9 for event in hands.events):
            event = min(hands.events, key=lambda at: abs(at - cloth.time))
            cloth.time = event
            cloth.hold(hands.take(event, cloth.positions), scene.motion(event)[1])
            followed.take(event)
        cloth.gravity, held, bodies = hands.driving(scene.motion)(end)
        cloth.step(end - cloth.time, held=held, bodies=bodies, damping=scene.damping(end))
        cloth.time = end
        if end >= frame / scene.frame_rate - 1e-9 or number == len(ends) - 1:
            times.append(end)
            positions.append(cloth.positions)
            derivatives.append(cloth.sensitivities[:1].reshape(-1, 3))
            frame = int(end * scene.frame_rate + 1e-9) + 1
    unrefined = cloth.sensitivity_report.unrefined
    return Repeated(np.array(times), np.array(positions), np.array(derivatives), unrefined)


def row(name: str, case: Case, changes: Sequence[float]) -> dict[str, Any]:
    """Return the errors of a case at each change of its parameter."""
    begin = time.process_time()
    ends = case.ends
    if ends is None:
        ends = case.family(CHOOSING).scene().run().step_ends.tolist()
    family = case.family(replace(CHOOSING, tolerance=TOLERANCE))
    run = repeated(family.differentiated([case.name]), ends)
    size = np.linalg.norm(run.derivatives, axis=(1, 2))
    depends = size > UNMOVED * run.positions.shape[1] ** 0.5
    value, unit = case.parameter.value, case.parameter.size
    by_change = {}
    for change in changes:
        h = change * unit
        high, low = (
            repeated(family.scene(**{case.name: value + step}), ends).positions for step in (h, -h)
        )
        errors = np.linalg.norm((high - low) / (2.0 * h) - run.derivatives, axis=(1, 2))
        errors = errors[depends] / size[depends]
        by_change[f"{change:g}"] = {
            "median": float(np.median(errors)),
            "worst": float(errors.max()),
        }
    return {
        "case": name,
        "parameter": case.name,
        "steps": len(ends),
        "frames": int(depends.sum()),
        "unrefined_steps": run.unrefined,
        "least_median": min(error["median"] for error in by_change.values()),
        "errors": by_change,
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


def closed_form(case: Case) -> float:
    """Return the relative error against dx/dmu = -g cos a t^2/2 on the incline."""
    assert case.ends is not None
    family = case.family(replace(CHOOSING, tolerance=TOLERANCE))
    run = repeated(family.differentiated(["mu"]), case.ends)
    exact = -GRAVITY * np.cos(SLOPE) * run.times**2 / 2.0
    return float(np.abs(run.derivatives[:, :, 0] / exact[:, None] - 1.0).max())


def cost(mesh: int) -> dict[str, Any]:
    """Return the CPU time of a drag of 131 s [s], and its ratio with one and three parameters."""
    drags = cloth_drag.family("gray-interlock", 0.4, mesh=mesh)

    def seconds(names: Sequence[str]) -> float:
        scene = drags.differentiated(names) if names else drags.scene()
        begin = time.process_time()
        scene.run()
        return time.process_time() - begin

    plain = seconds([])
    return {
        "mesh": mesh,
        "cpu_seconds": round(plain, 1),
        "one_parameter": round(seconds(["mu"]) / plain, 2),
        "three_parameters": round(seconds(["mu", "bending", "density"]) / plain, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", help=", ".join(CASES))
    parser.add_argument("--changes", nargs="+", type=float, default=CHANGES)
    parser.add_argument("--cost", type=int, metavar="MESH")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.cost:
        print(json.dumps(cost(arguments.cost)))
        return
    names = arguments.cases or [name for name in CASES if name not in SLOW]
    rows = []
    for name in names:
        rows.append(row(name, CASES[name], arguments.changes))
        if name == "incline":
            rows[-1]["closed_form"] = closed_form(CASES[name])
        print(json.dumps(rows[-1]), flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
