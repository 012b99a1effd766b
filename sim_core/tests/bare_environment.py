"""Try an installed wheel where nothing but NumPy is: a drop, a drag, rods and a fit.

cibuildwheel runs this file in the environment of each wheel. It prints what it found.
"""

import sys
import time
from importlib import import_module
from importlib.metadata import distributions, requires

ALLOWED = {"numpy", "stickslip-sim-core", "pip", "setuptools", "wheel"}


def main() -> None:
    """Import the package, simulate, and compare with closed forms."""
    begin = time.process_time()
    core = import_module("stickslip_sim_core")
    imported = time.process_time() - begin
    np = import_module("numpy")
    scenes = import_module("stickslip_sim_core.scenes.cloth_drag")

    strangers = {distribution.metadata["Name"] for distribution in distributions()} - ALLOWED
    assert not strangers, f"the environment is not bare: {sorted(strangers)}"
    needs = [line for line in requires("stickslip-sim-core") or [] if "extra ==" not in line]
    assert [line[:5] for line in needs] == ["numpy"], needs

    # A free fall, without a body: g t^2/2.
    meshes = import_module("stickslip_sim_core.cloth.meshes")
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = core.Cloth(mesh, core.fabric("gray-interlock"), core.preset_named("certified"))
    cloth.set_state(np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]))
    for _ in range(10):
        cloth.step(0.02)
    fallen = -float(cloth.positions[:, 2].mean())
    assert abs(fallen / (0.5 * 9.81 * 0.2**2) - 1.0) < 0.12, fallen

    run = scenes.scene("gray-interlock", 0.5, mesh=11).run()
    assert np.isfinite(run.positions).all()

    rods = core.solve_rods([50.0], [1.0], [4.0], points=201)
    fit = core.fit_parameters(rods.centerline[0])
    assert abs(fit.gamma / 50.0 - 1.0) < 1e-3, fit.gamma
    sys.stdout.write(
        f"Python {sys.version.split()[0]}, NumPy {np.__version__}: import {imported:.2f} CPU s\n"
    )


if __name__ == "__main__":
    main()
