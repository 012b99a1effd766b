"""Results are equal to the recorded ones, bit by bit: SHA-256 of what short scenes return.

    python sim_core/tests/test_golden.py           # compare with golden.json
    python sim_core/tests/test_golden.py --record  # after a change meant to change results: say why

Cloth runs with the kernel level named, so that the level `baseline` gives the same bits on any
x86-64 processor. So do rods of varying curvature with BLAS of the oldest kernels: they are
interpolated by matrix products.
"""

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stickslip_testing.contact_scenes import SCENES

from stickslip_sim_core import (
    Cloth,
    box,
    build_info,
    fabric,
    isotropic,
    plane,
    preset_named,
    solve_general_rods,
    solve_rods,
    sphere,
)
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.scenes import cloth_drag

pytestmark = pytest.mark.physics

RECORDED = Path(__file__).with_name("golden.json")
KERNEL = "STICKSLIP_CLOTH_KERNEL"
KERNELS = ("baseline", "x86-64-v3", "x86-64-v4")


def digest(*arrays: NDArray[np.generic]) -> str:
    """Return the SHA-256 of the arrays' bytes."""
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    ).hexdigest()


def fallen(material: str, mesh: meshes.Mesh, *, box_below: bool) -> str:
    """Drop a sheet with one held corner onto a floor and a turning sphere, or a box that moves."""
    cloth = Cloth(mesh, fabric(material), preset_named("certified"), held=[0])
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.045)]))
    ends = cloth.positions[[0]]
    for step in range(50):
        angle = 0.05 * step
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        body = (
            box(0.5, (0.05, 0.05, 0.06), rounding=0.01, origin=(0.0005 * step, 0.0, 0.0))
            if box_below
            else sphere(0.6, 0.03, rotation=turn)
        )
        cloth.step(
            0.02,
            held=ends + 0.0005 * step * np.array([1.0, 0.0, -1.0]),
            bodies=[plane(0.3), body],
            damping=0.5,
        )
    return digest(cloth.positions, cloth.velocities, cloth.reactions, cloth.contacts, cloth.sliding)


def clamped() -> str:
    """Let a clamped strip with Poisson's ratio sag under its weight."""
    mesh = meshes.unstructured(0.02, 0.1, 0.005, 1)
    at_clamp = mesh.rest[:, 1] < -0.043
    cloth = Cloth(
        mesh,
        isotropic(0.2, 500.0, 1e-5, 0.3),
        preset_named("certified"),
        held=np.flatnonzero(at_clamp),
    )
    flat = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    cloth.set_state(flat)
    for _ in range(40):
        cloth.step(0.02, held=flat[at_clamp], damping=3.0)
    return digest(cloth.positions, cloth.reactions)


def dragged(material: str, mu: float, vertices: int, frames: int, preset: str) -> str:
    """Drop and drag a cloth that passes through itself."""
    scene = cloth_drag.scene(
        material, mu, mesh=vertices, frames=frames, preset=preset, seed=1, self_friction=None
    ).run()
    counts = np.array([scene.labels["steps"], scene.labels["unconverged_steps"]])
    forces = (scene.record[name] for name in ("contact_force", "holder_force"))
    return digest(scene.positions, *forces, scene.self_intersections, counts)


def touching(scene: str) -> str:
    """Run a scene in which cloth touches itself."""
    cloth = SCENES[scene](preset_named("certified"))
    counts = np.array([cloth.total.newton, cloth.total.krylov])
    return digest(cloth.positions, cloth.velocities, cloth.pair_forces.forces, counts)


def rods() -> str:
    """Solve 64 rods of the thesis's ranges."""
    gamma, phi0, phi1 = np.random.default_rng(1).uniform([100, 0.2, 6], [1300, 12, 20], (64, 3)).T
    solution = solve_rods(gamma, phi0, phi1)
    return digest(
        solution.centerline, solution.curvature, solution.frame, solution.energy, solution.stable
    )


def general_rods() -> str:
    """Solve 8 rods of varying natural curvature."""
    natural = np.random.default_rng(2).uniform(-8.0, 8.0, (8, 5, 3))
    solution = solve_general_rods(natural, np.linspace(50.0, 800.0, 8))
    return digest(solution.centerline, solution.curvature, solution.energy, solution.stable)


def general_rods_anywhere() -> str:
    """Solve these in a process whose BLAS does not look what the processor can do."""
    return subprocess.run(
        [sys.executable, "-c", "import test_golden; print(test_golden.general_rods())"],
        cwd=Path(__file__).parent,
        env={**os.environ, "OPENBLAS_CORETYPE": "Nehalem"},
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()


CLOTH: dict[str, Callable[[], str]] = {
    "plane and sphere, unstructured": lambda: fallen(
        "gray-interlock", meshes.unstructured(0.1, 0.1, 0.01, 3), box_below=False
    ),
    "plane and box, grid": lambda: fallen(
        "camel-ponte-roma", meshes.grid(0.1, 0.1, 11, 11), box_below=True
    ),
    "clamped strip": clamped,
    "drop and drag, 11, first turn": lambda: dragged("gray-interlock", 0.5, 11, 100, "certified"),
    "drop and drag, 21, touchdown": lambda: dragged("11oz-black-denim", 1.2, 21, 30, "certified"),
    "three sheets in a pile": lambda: touching("pile"),
    "a strip that folds": lambda: touching("fold"),
    "a sheet on a ball of triangles": lambda: touching("ball"),
    "a sheet between walls": lambda: touching("squeeze"),
    "drop and drag, 15, fast": lambda: dragged("camel-ponte-roma", 0.3, 15, 60, "fast"),
}
RODS: dict[str, Callable[[], str]] = {"rods": rods, "general rods": general_rods_anywhere}


def results(kernel: str) -> dict[str, str]:
    """Return digests by scene with this level of the cloth kernels."""
    before = os.environ.get(KERNEL)
    os.environ[KERNEL] = kernel
    try:
        return {name: scene() for name, scene in CLOTH.items()}
    finally:
        if before is None:
            del os.environ[KERNEL]
        else:
            os.environ[KERNEL] = before


@pytest.fixture(scope="module")
def recorded() -> dict[str, Any]:
    """What is recorded, if this machine can be expected to give the same bits."""
    document: dict[str, Any] = json.loads(RECORDED.read_text(encoding="utf-8"))
    if (
        platform.machine() not in ("x86_64", "AMD64")
        or build_info().compiler != document["compiler"]
    ):
        pytest.skip(
            f"recorded with {document['compiler']} on x86-64: others may give other last digits"
        )
    return document


@pytest.mark.parametrize("name", RODS)
def test_rods(recorded: dict[str, Any], name: str) -> None:
    assert RODS[name]() == recorded["rods"][name]


def test_cloth_on_the_level_that_every_processor_runs(recorded: dict[str, Any]) -> None:
    assert results("baseline") == recorded["cloth"]["baseline"]


def main() -> None:
    """Compare with what is recorded, or record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    digests = {
        "compiler": build_info().compiler,
        "rods": {name: scene() for name, scene in RODS.items()},
        "cloth": {kernel: results(kernel) for kernel in KERNELS},
    }
    if args.record:
        RECORDED.write_text(json.dumps(digests, indent=2) + "\n", encoding="utf-8")
        return
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
    print("equal" if digests == recorded else f"different:\n{json.dumps(digests, indent=2)}")


if __name__ == "__main__":
    main()
