"""An adapter runs in a process of its own. What goes wrong in it has a name and a reason."""

import ast
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stickslip_measure import adapters
from stickslip_measure.contract import Body, Floats, Sheet
from stickslip_measure.process import (
    AdapterError,
    AdapterProcess,
    ContractError,
    CrashError,
    HangError,
    NotFiniteError,
    Program,
    SetupError,
    Simulation,
    SlowError,
    StepError,
    describe,
)
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import SelfContact, plane
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.inclined_plane import ROUGHER, OnSlope, Stack

Adapter = Callable[..., Program]

STICKSLIP = Program(Path(adapters.__file__).with_name("stickslip.py"))
DOWN = np.array([0.0, 0.0, -GRAVITY])
MU = 0.3


def patch(cells: int = 4) -> Sheet:
    """Return a patch on a floor."""
    mesh = meshes.grid(0.1, 0.1, cells, cells)
    return Sheet(
        mesh.rest,
        np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]),
        mesh.triangles,
        np.zeros(len(mesh.rest), dtype=np.int32),
        mesh.spacing,
        density=0.2,
        stretching=100.0,
        bending=1e-5,
        bodies=(Body("plane", MU, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),),
    )


def fall(program: Program, log: Path, seconds: float = 30.0, duration: float = 0.3) -> Floats:
    """Return the positions of a patch that has fallen."""
    with AdapterProcess(program, log, seconds) as process:
        simulation = Simulation(process, patch(), "default")
        simulation.rest(duration, DOWN)
        return simulation.positions


def test_an_adapter_is_not_the_simulator_of_its_name(
    written: Callable[[str], Program], tmp_path: Path
) -> None:
    # `import mujoco` in mujoco.py, where MuJoCo is not installed.
    with pytest.raises(
        SetupError, match=re.escape("No module named 'adapter' (adapter.py, line 1)")
    ):
        describe(written("import adapter"), tmp_path / "log", 60.0)


def test_a_step_advances_and_returns_positions(falling: Adapter, tmp_path: Path) -> None:
    end = fall(falling(), tmp_path / "log")
    # Velocity first, then position: the distance of t is g t (t + dt)/2.
    np.testing.assert_allclose(end[:, 2], -0.5 * GRAVITY * 0.3 * 0.31, rtol=1e-12)


def test_what_a_simulator_prints_does_not_disturb(falling: Adapter, tmp_path: Path) -> None:
    fall(falling(step="print('hello'); os.system('echo hi')"), tmp_path / "log")
    assert "hello" in (tmp_path / "log").read_text()


@pytest.mark.parametrize(
    ("step", "start", "error", "reason"),
    [
        ("raise KeyError('v')", "pass", StepError, r"KeyError: 'v' \(adapter\.py, line 20\)"),
        ("pass", "raise RuntimeError('no GPU')", SetupError, r"no GPU \(adapter\.py, line 13\)"),
        ("pass", "del Simulator.frame", SetupError, "frame"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "pass", CrashError, "signal SIGSEGV"),
        ("raise SystemExit(3)", "pass", CrashError, "exit code 3"),
        ("self.x[0] = np.nan", "pass", NotFiniteError, "NaN"),
        ("self.x[0] = 1e9", "pass", NotFiniteError, r"beyond 1e\+06 m"),
        ("self.x = self.x[:3]; self.v = self.v[:3]", "pass", ContractError, "must have shape"),
    ],
)
def test_failures_have_a_name_and_a_reason(
    falling: Adapter,
    tmp_path: Path,
    step: str,
    start: str,
    error: type[AdapterError],
    reason: str,
) -> None:
    with pytest.raises(error, match=reason):
        fall(falling(step, start), tmp_path / "log")


@pytest.mark.parametrize("frame", ["0.0", "float('nan')", "-1.0"])
def test_a_frame_that_is_no_time_breaks_the_contract(
    falling: Adapter, tmp_path: Path, frame: str
) -> None:
    with pytest.raises(ContractError, match="frame: must be finite and > 0"):
        fall(falling(frame=frame), tmp_path / "log")


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        ("time.sleep(600)", "step 1 of the scene, which begins at 0 s, did not end"),
        (
            "time.sleep(600 if self.time > 0.185 else 0)",
            r"step 20 of the scene, which begins at 0\.19 s, did not end within .* before it took",
        ),
    ],
    ids=["first", "later"],
)
def test_a_step_that_does_not_end_is_named(
    falling: Adapter, tmp_path: Path, step: str, reason: str
) -> None:
    with AdapterProcess(falling(step=step), tmp_path / "log", 60.0) as process:
        simulation = Simulation(process, patch(), "default")
        process.patience = 0.5
        with pytest.raises(HangError, match=reason):
            simulation.rest(0.3, DOWN)


def test_slow_is_not_hanging(falling: Adapter, tmp_path: Path) -> None:
    slow = falling(step="time.sleep(0.1)")
    with AdapterProcess(slow, tmp_path / "log", 60.0) as process:
        simulation = Simulation(process, patch(), "default")
        process.deadline = time.monotonic() + 1.5
        with pytest.raises(SlowError, match=r"limit of 60 s .* was at 0\.1\d? s, after 1\d steps"):
            simulation.rest(10.0, DOWN)


def test_a_step_that_is_far_longer_than_the_others_hangs_also_at_the_end_of_the_time(
    falling: Adapter, tmp_path: Path
) -> None:
    program = falling(step="time.sleep(600 if self.time > 0.045 else 0)")
    with AdapterProcess(program, tmp_path / "log", 60.0) as process:
        simulation = Simulation(process, patch(), "default")
        process.deadline = time.monotonic() + 2.0
        with pytest.raises(HangError, match="step 6 of the scene"):
            simulation.rest(0.3, DOWN)


def test_a_constructor_that_does_not_end(falling: Adapter, tmp_path: Path) -> None:
    program = falling(start="time.sleep(600)")
    with (
        AdapterProcess(program, tmp_path / "log", 4.0) as process,
        pytest.raises(HangError, match="its constructor did not end within 2 s"),
    ):
        Simulation(process, patch(), "default")


def test_an_import_that_does_not_end(written: Callable[[str], Program], tmp_path: Path) -> None:
    program = written("import time\ntime.sleep(600)")
    with pytest.raises(HangError, match=r"its import did not end within 0\.5 s"):
        describe(program, tmp_path / "log", 1.0)


def test_an_interpreter_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match="/nowhere/python does not start: No such file"):
        fall(Program(STICKSLIP.adapter, "/nowhere/python"), tmp_path / "log")


def test_files_of_the_package_hide_no_module_of_the_simulator(
    falling: Adapter, tmp_path: Path
) -> None:
    (tmp_path / "host.py").write_text("WHOSE = 'the simulator'\n")
    program = falling(start="import host; assert host.WHOSE == 'the simulator'")
    fall(program, tmp_path / "log")
    assert describe(program, tmp_path / "log", 30.0).python == sys.version.split()[0]


@pytest.mark.parametrize("name", ["contract.py", "host.py", "wire.py"])
def test_what_runs_beside_a_simulator_is_python_3_9(name: str) -> None:
    path = Path(adapters.__file__).parents[1] / name
    tree = ast.parse(path.read_text(), feature_version=(3, 9))
    # Annotations stay text, so those of newer Pythons do no harm.
    assert "annotations" in ast.unparse(tree.body[1])


class SlopeOfStack(OnSlope):
    """The slopes through which the protocol `stacked-incline` goes."""

    share_from = Stack.share_from
    share_to = Stack.share_to
    rate = Stack.rate
    slid = Stack.slid


def stack() -> Sheet:
    """Return a sheet on a wider sheet, on a rougher floor."""
    lower = meshes.grid(0.15, 0.15, 6, 6)
    upper = meshes.grid(0.1, 0.1, 4, 4)
    whole = meshes.together(lower, upper)
    level = np.repeat(np.arange(2, dtype=np.int32), [len(lower.rest), len(upper.rest)])
    points = np.concatenate([lower.rest, upper.rest])
    return replace(
        patch(),
        rest=whole.rest,
        start=np.column_stack([points, 5e-4 * level]),
        triangles=whole.triangles,
        sheet=level,
        bodies=(Body("plane", ROUGHER * MU, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),),
        friction=MU,
        gap=5e-4,
    )


def laid(scene: Sheet) -> Cloth:
    """Return the cloth of a scene, as protocols make it."""
    # Protocols give each pair of sheets its friction, here also that of a sheet with itself.
    friction = MU * np.array([[ROUGHER, 1.0], [1.0, ROUGHER]])
    touch = None if scene.friction is None else SelfContact(friction, scene.gap)
    return Cloth(
        meshes.Mesh(scene.rest, scene.triangles),
        isotropic(scene.density, scene.stretching, scene.bending),
        preset_named("certified"),
        self_contact=touch,
        force_scale=0.1 * scene.density * scene.cell**2 * GRAVITY,
    )


@pytest.mark.physics
@pytest.mark.parametrize("verb", ["slip_slope", "drift"])
@pytest.mark.parametrize(
    ("scene", "kind"), [(patch(), OnSlope), (stack(), SlopeOfStack)], ids=["patch", "stack"]
)
def test_the_core_by_its_adapter_gives_the_numbers_of_the_protocol(
    scene: Sheet, kind: type[OnSlope], verb: str, tmp_path: Path
) -> None:
    """Slope of slip and creep, by the steps of `OnSlope`, with the positions of a process."""
    direct = laid(scene)
    floor = scene.bodies[0].friction
    upper = scene.sheet == scene.sheet.max()
    protocol = kind(direct, scene.start, MU, floor, upper)
    with AdapterProcess(STICKSLIP, tmp_path / "log", 60.0) as process:
        remote_cloth = RemoteCloth(Simulation(process, scene, "default"), direct.preset)
        remote = kind(remote_cloth, scene.start, MU, floor, upper)  # type: ignore[arg-type]
        expected = getattr(protocol, verb)()
        assert np.isfinite(expected)
        # Bit by bit: neither the process nor the adapter changes a number.
        assert getattr(remote, verb)() == expected
        np.testing.assert_array_equal(remote_cloth.positions, direct.positions)


class RemoteCloth:
    """The verbs of `Cloth` that a protocol of slopes uses, by an adapter."""

    def __init__(self, simulation: Simulation, preset: object) -> None:
        self.simulation = simulation
        self.preset = preset
        self.gravity = np.tile(DOWN, (len(simulation.positions), 1))

    @property
    def positions(self) -> Floats:
        return self.simulation.positions

    def set_state(self, start: Floats) -> None:
        np.testing.assert_array_equal(self.positions, start)

    def step(self, dt: float, bodies: object) -> None:
        scene = self.simulation.scene
        assert isinstance(scene, Sheet)
        assert repr(bodies) == repr([plane(scene.bodies[0].friction)])
        assert dt == self.simulation.frame
        self.simulation.advance(self.gravity[:1])
