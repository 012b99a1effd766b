"""A campaign goes on after a fault, and where it was interrupted."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_measure import experiments
from stickslip_measure.campaign import Cell, Request, measure, read_cell
from stickslip_measure.cli import PROGRAM_VARIABLE, main
from stickslip_measure.convergence import converged
from stickslip_measure.diagnosis import findings
from stickslip_measure.experiments import capstan, drape, slopes, strips
from stickslip_measure.laboratory import DOWN, NoValueError, SleepError, settled
from stickslip_measure.page import write_page
from stickslip_measure.process import Program
from stickslip_sim_core.reference import master_curves

Adapter = Callable[..., Program]

LATE = "if self.time > 0.295:"
"""The fall takes 0.3 s, and all other scenes more."""


def measured(program: Program, out: Path, *names: str, seconds: float = 60.0) -> list[Cell]:
    """Measure the default row, and return its cells."""
    cells: list[Cell] = []
    request = Request(program, out, names, ("default",), seconds)
    measure(request, lambda cell, is_recorded: cells.append(cell))
    return cells


@pytest.mark.parametrize(
    ("step", "state"),
    [
        (f"{LATE} raise ValueError('lost')", "failed"),
        (f"{LATE} os.kill(os.getpid(), signal.SIGKILL)", "crashed"),
        (f"{LATE} self.x = self.x * np.nan", "not finite"),
    ],
)
def test_a_fault_is_a_cell_and_the_others_go_on(
    falling: Adapter, tmp_path: Path, step: str, state: str
) -> None:
    cells = measured(falling(step), tmp_path, "incline-onset", "pinch")
    assert [cell.state for cell in cells] == [
        "measured",
        state,
        *[state] * 3,
        *["not supported"] * 3,
    ]
    assert cells[-1].reason == "needs curved, planes"
    assert cells[0].value == pytest.approx(1.0)


def test_a_lie_about_time_is_named(falling: Adapter, tmp_path: Path) -> None:
    liar = falling(step="self.x += 0; self.frame = 0.008")
    cells = measured(liar, tmp_path)
    faults = findings(cells)
    assert faults[0].fault == "steps cover another time than they state"
    assert "a second of its time is 0.800 s" in faults[0].evidence


def test_a_lie_about_time_spoils_what_moves(falling: Adapter, tmp_path: Path) -> None:
    # From the second step on, a step covers twice the time that it states.
    liar = falling(step="self.x += 0; self.frame = 0.02")
    cells = measured(liar, tmp_path, "kinetic-friction")
    (fault,) = (each for each in findings(cells) if each.fault.startswith("steps cover"))
    assert fault.spoiled == ("kinetic-friction",)
    assert fault.text.endswith("because of this, values are wrong: kinetic-friction")
    page = write_page(tmp_path).read_text()
    assert 'title="because of this: steps cover another time than they state"' in page
    # What no run has asked for is another thing than what the adapter cannot do.
    assert 'data-column="pinch">not requested</td>' in page
    assert 'data-column="verdict">not requested</td>' in page


def cells_with(experiment: str, value: float, counts: tuple[int, ...] = (5, 10, 20)) -> list[Cell]:
    """Return cells of an experiment that all have one value, of an expected 1."""
    return [
        Cell("s", "1", "default", experiment, count, "measured", "", value, 1.0, 0.0, "")
        for count in counts
    ]


@pytest.mark.parametrize(
    ("still", "faults"),
    [(0.8, ["steps cover", "friction is 0.800"]), (1.0, ["steps cover"])],
)
def test_a_lie_about_time_hides_no_factor_on_friction(still: float, faults: list[str]) -> None:
    (fall,) = cells_with("fall", 0.64, (4,))
    fall = replace(fall, details={"size at the start over the scene's": 1.0})
    # The wrong time spoils what moves; two experiments show how much friction holds.
    moving = [*cells_with("kinetic-friction", 0.5), *cells_with("pull-out", 0.5)]
    holding = [*cells_with("house-of-cards", still), *cells_with("pinch", still)]
    named = [finding.fault for finding in findings([fall, *moving, *holding])]
    assert len(named) == len(faults)
    assert all(map(str.startswith, named, faults))


def test_drag_is_no_lie_about_time(falling: Adapter, tmp_path: Path) -> None:
    cells = measured(falling(step="self.v *= 0.97"), tmp_path)
    assert findings(cells)[0].fault == "something brakes a free fall"


@pytest.mark.physics
def test_a_campaign_goes_on_where_it_stopped(falling: Adapter, tmp_path: Path) -> None:
    program = falling(step=f"{LATE} raise ValueError('lost')")
    measured(program, tmp_path, "creep")
    path = tmp_path / "falling" / "default" / "creep-10.json"
    first = path.stat().st_mtime_ns
    measured(program, tmp_path, "creep")
    assert path.stat().st_mtime_ns == first
    # A cell without a value is repeated on request, and every cell of a changed adapter is.
    request = Request(program, tmp_path, ("creep",), ("default",), 60.0, retry="missing")
    measure(request, lambda cell, is_recorded: None)
    second = path.stat().st_mtime_ns
    assert second > first
    measured(falling(step=f"{LATE} raise ValueError('gone')"), tmp_path, "creep")
    assert read_cell(path).reason == "ValueError: gone (adapter.py, line 20)"


@pytest.mark.parametrize("when", ["import", "constructor"])
def test_a_change_of_an_imported_module_is_measured(
    written: Callable[[str], Program], falling_text: str, tmp_path: Path, when: str
) -> None:
    places = {
        "import": f"import physics\n{falling_text}",
        "constructor": falling_text.replace(
            "self.x = scene", "global physics; import physics; self.x = scene"
        ),
    }
    text = places[when].replace("self.gravity * self.frame", "np.array(physics.PULL) * self.frame")
    program = written(text)
    module = tmp_path / "physics.py"
    out = tmp_path / "out"
    flags: list[bool] = []
    values = []
    for pull in (-9.81, -9.81, -4.905):
        module.write_text(f"PULL = [0.0, 0.0, {pull}]\n")
        request = Request(program, out, (), ("default",), 60.0)
        measure(request, lambda cell, is_recorded: flags.append(is_recorded))
        values.append(read_cell(out / "falling" / "default" / "fall-4.json").value)
    assert values == pytest.approx([1.0, 1.0, 0.5])
    # The checks are two cells; `balance` ran, too, since the patch says that it can hold vertices.
    assert flags == [False, False, True, True, False, False]
    sources = read_cell(out / "falling" / "default" / "fall-4.json").sources
    assert set(sources) == {str(program.adapter), str(module)}


@pytest.mark.parametrize(
    ("fault", "state"),
    [
        ("import os; os._exit(3)", "crashed"),
        ("import time; time.sleep(600)", "hangs"),
        ("raise ValueError('gone')", "failed"),
    ],
)
def test_a_module_that_ends_a_step_is_measured_again_once_it_is_mended(
    falling: Adapter, tmp_path: Path, fault: str, state: str
) -> None:
    module = tmp_path / "physics.py"
    module.write_text(f"{fault}\n")
    program = falling(step="import physics")
    path = tmp_path / "falling" / "default" / "fall-4.json"
    measured(program, tmp_path, seconds=4.0)
    assert read_cell(path).state == state
    assert str(module) in read_cell(path).sources
    module.write_text("PULL = 1.0\n")
    measured(program, tmp_path)
    assert read_cell(path).value == pytest.approx(1.0)


def test_a_cell_of_an_older_version_is_measured_again(falling: Adapter, tmp_path: Path) -> None:
    measured(falling(), tmp_path)
    path = tmp_path / "falling" / "default" / "fall-4.json"
    facts = json.loads(path.read_text())
    path.write_text(json.dumps({**facts, "sources": {}, "value": 7.0}))
    measured(falling(), tmp_path)
    assert read_cell(path).value == pytest.approx(1.0)


def test_a_cell_that_hangs_spares_the_finer_ones_and_shortens_the_others(
    falling: Adapter, tmp_path: Path
) -> None:
    program = falling(step=f"{LATE} time.sleep(600)")
    cells = measured(program, tmp_path, "creep", "incline-onset", seconds=10.0)
    states = {(cell.experiment, cell.cells): cell for cell in cells}
    assert states["creep", 5].state == states["incline-onset", 5].state == "hangs"
    assert states["creep", 10].reason == "a coarser mesh hangs"
    assert {states["creep", n].state for n in (10, 20)} == {"not run"}
    # The first of them, a check, has half of the limit, and all others a tenth.
    assert "did not end within 5 s" in states["balance", 4].reason
    assert "did not end within 1 s" in states["creep", 5].reason
    assert "did not end within 1 s" in states["incline-onset", 5].reason


def test_a_cell_whose_cpu_time_is_over_ends_and_finer_ones_are_not_run(
    falling: Adapter, tmp_path: Path
) -> None:
    cells: list[Cell] = []
    busy = falling(step="while time.process_time() < 0.3 + self.time: pass")
    request = Request(busy, tmp_path, ("creep",), ("default",), 60.0, budget=0.5)
    measure(request, lambda cell, is_recorded: cells.append(cell))
    states = {(cell.experiment, cell.cells): cell.state for cell in cells}
    assert states["creep", 5] == "not finished"
    assert states["creep", 10] == states["creep", 20] == "not run"


def test_another_version_of_the_simulator_is_measured_anew(
    written: Callable[[str], Program], falling_text: str, tmp_path: Path
) -> None:
    """The adapter asks its simulator for the version, so its own text does not change."""
    text = f"from pathlib import Path\n{falling_text}".replace(
        'version = "1"', "version = Path(__file__).with_name('version').read_text()"
    )
    versions = []
    for version in ("1.0", "1.1"):
        (tmp_path / "version").write_text(version)
        measured(written(text), tmp_path)
        versions.append(read_cell(tmp_path / "falling" / "default" / "fall-4.json").version)
    assert versions == ["1.0", "1.1"]


def test_the_page_says_who_holds_and_why_a_cell_has_no_value(
    falling: Adapter, tmp_path: Path
) -> None:
    measured(falling(step=f"{LATE} raise ValueError('<lost>')"), tmp_path, "creep", "pinch")
    page = write_page(tmp_path).read_text()
    assert "<h1>Who holds, and who creeps</h1>" in page
    # The verdict, the cell of creep, and the reason of both; text of an adapter is no markup.
    reason = "ValueError: &lt;lost&gt; (adapter.py, line 20)"
    assert f'class="none" data-column="verdict" title="{reason}">no answer</td>' in page
    assert "failed: ValueError: &lt;lost&gt;" in page
    assert "<lost>" not in page
    assert "not supported: needs curved, planes" in page
    # The fall has a curve, and says what the adapter did.
    assert 'aria-label="A patch falls: height [mm] against time [s]"' in page
    assert "step: 10 ms" in page
    # And when, where and with which limit it was measured.
    assert re.search(r"Measured on 20\d\d-\d\d-\d\d on .* with at most 600 s of CPU time", page)


def test_the_command_writes_a_page_or_says_that_nothing_was_measured(
    falling: Adapter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["--out", str(out)]) == 1
    assert "has no results; name a simulator with --simulator" in capsys.readouterr().err
    adapter = str(falling().adapter)
    assert main(["--simulator", adapter, "--experiment", "pinch", "--out", str(out)]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == str(out / "index.html")
    assert (out / "index.html").exists()


def test_lines_say_what_is_of_an_earlier_run(
    falling: Adapter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    adapter = str(falling().adapter)
    command = ["--simulator", adapter, "--experiment", "kinetic-friction", "--out", str(tmp_path)]
    note = "results are of an earlier run; --retry all measures them again"
    assert main(command) == 0
    first = capsys.readouterr().out
    assert "default    kinetic-friction     5 cells" in first
    assert "earlier run" not in first
    assert main(command) == 0
    second = capsys.readouterr().out
    assert second.count("[from an earlier run]") == 5
    assert f"5 of 5 {note}" in second
    assert main([*command, "--retry", "all"]) == 0
    assert "earlier run" not in capsys.readouterr().out


def test_a_run_without_a_value_says_where_the_tracebacks_are(
    falling: Adapter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    adapter = str(falling(f"{LATE} raise TypeError('lost')").adapter)
    command = ["--simulator", adapter, "--experiment", "creep", "--out", str(tmp_path)]
    assert main(command) == 1
    printed = capsys.readouterr().out
    assert "failed: TypeError: lost (adapter.py, line 20)" in printed
    place = tmp_path / "falling" / "ROW" / "EXPERIMENT-CELLS.log"
    assert f"Tracebacks and other output: {place}" in printed
    log = place.parents[1] / "default" / "creep-5.log"
    assert 'adapter.py", line 20, in step' in log.read_text()


@pytest.mark.parametrize("name", ["stickslip measure", "stickslip-measure"])
def test_the_usage_names_the_command_of_the_user(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name == "stickslip measure":
        monkeypatch.setenv(PROGRAM_VARIABLE, name)
    with pytest.raises(SystemExit):
        main(["--timeout", "0"])
    assert capsys.readouterr().err.startswith(f"usage: {name} [-h]")


def test_faults_are_those_of_the_requested_experiments(
    falling: Adapter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    adapter = str(falling().adapter)
    # It falls along the slope, too, and so creeps by metres.
    main(["--simulator", adapter, "--experiment", "creep", "--out", str(tmp_path)])
    assert "cloth creeps" in capsys.readouterr().out
    # The curve goes up to the time of the value.
    assert read_cell(tmp_path / "falling" / "default" / "creep-5.json").x[-1] == 10.0
    main(["--simulator", adapter, "--experiment", "kinetic-friction", "--out", str(tmp_path)])
    assert "cloth creeps" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("class Simulator:", "class Falling:"), "must define the class Simulator, got Falling"),
        (('    version = "1"', "    pass"), "the class Simulator must have version"),
        (
            ('"default"', '"other"'),
            "must be a row of the adapter's `settings` (other), got default",
        ),
    ],
)
def test_an_adapter_that_breaks_the_contract_at_once(
    written: Callable[[str], Program],
    falling_text: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: tuple[str, str],
    message: str,
) -> None:
    program = written(falling_text.replace(*change))
    command = ["--simulator", str(program.adapter), "--out", str(tmp_path / "out")]
    assert main([*command, "--setting", "default"]) == 1
    errors = capsys.readouterr().err
    assert message in errors
    assert f"{tmp_path / 'out' / 'adapter.log'} has its output" in errors


def test_a_damaged_cell_says_what_to_do(falling: Adapter, tmp_path: Path) -> None:
    measured(falling(), tmp_path)
    path = tmp_path / "falling" / "default" / "fall-4.json"
    path.write_text("{}")
    with pytest.raises(ValueError, match="is no result: delete it and measure again"):
        measured(falling(), tmp_path)


def test_limit_and_order() -> None:
    trend = converged((10, 20, 40), [3.0 + 5.0 / n**2 for n in (10, 20, 40)], 3.0)
    assert trend.limit == pytest.approx(3.0)
    assert trend.order == pytest.approx(2.0)
    assert trend.reason == ""


@pytest.mark.parametrize(
    ("values", "expected", "reason"),
    [
        ([1.0, None, 1.0], 1.0, "needs three values"),
        ([1.0, 1.1, 1.05], 1.0, "does not converge: goes up and down"),
        ([1.0, 1.1, 1.3], 1.0, "does not converge: its changes fall by 0.5"),
        ([1.0, 3.0, 3.002], 1.0, "does not converge: its changes fall by 1e+03"),
    ],
)
def test_values_that_do_not_converge_have_no_limit(
    values: list[float | None], expected: float, reason: str
) -> None:
    trend = converged((10, 20, 40), values, expected)
    assert np.isnan(trend.limit)
    assert np.isnan(trend.order)
    assert trend.reason == reason


@pytest.mark.parametrize(("expected", "spread"), [(2.0, 1e-3), (0.0, 0.005)])
def test_values_that_hardly_change_have_a_limit_and_no_order(
    expected: float, spread: float
) -> None:
    trend = converged((10, 20, 40), [expected, expected + spread, expected], expected)
    assert trend.limit == expected
    assert np.isnan(trend.order)
    assert trend.reason == "does not change"


def test_there_are_twelve_experiments_with_three_resolutions() -> None:
    assert len(experiments.EXPERIMENTS) == 12
    assert {len(experiment.cells) for experiment in experiments.EXPERIMENTS.values()} == {3}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--simulator", "toy.py"), "the file 'toy.py' does not exist"),
        (("--simulator", "bullet4"), "must be a Python file or one of bullet, elastica"),
        (("--experiment", "fold"), "invalid choice: 'fold'"),
        (("--timeout", "-3"), "must be above 0 and below 1e6 s"),
        (("--setting", "best"), "invalid choice: 'best'"),
    ],
)
def test_wrong_arguments_are_refused(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert message in capsys.readouterr().err


def test_an_adapter_that_cannot_be_imported(
    falling: Adapter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = falling(start="pass", name="undefined")
    assert main(["--simulator", str(program.adapter), "--out", str(tmp_path / "out")]) == 1
    assert "could not be set up: NameError" in capsys.readouterr().err


class Moving:
    """A scene of one vertex, whose height is a function of the time."""

    def __init__(self, height: Callable[[float], float]) -> None:
        self.height = height
        self.time = 0.0
        self.positions = np.array([[0.0, 0.0, height(0.0)]])

    def rest(self, seconds: float, gravity: object) -> np.ndarray:
        times = self.time + seconds * np.arange(1, 26) / 25.0
        frames = np.array([[[0.0, 0.0, self.height(time)]] for time in times])
        self.time = times[-1]
        self.positions = frames[-1]
        return frames


def test_a_scene_that_swings_rests_at_its_mean() -> None:
    swing: Any = Moving(lambda time: 0.02 + 0.05 * np.sin(9.0 * time))
    assert settled(swing, DOWN, 0.1, 12.0)[0, 2] == pytest.approx(0.02, abs=3e-3)


def test_a_scene_that_goes_on_moving_has_no_rest() -> None:
    sagging: Any = Moving(lambda time: -0.01 * time)
    with pytest.raises(NoValueError, match=r"did not come to rest in 12 s: .* moves by 30 mm"):
        settled(sagging, DOWN, 0.1, 12.0)


def test_a_patch_that_sticks_does_not_sleep() -> None:
    slopes.check_nudge(slopes.Nudge(0.1, 0.99))
    with pytest.raises(SleepError, match=r"3\.0 times the slip moved it by 0 mm"):
        slopes.check_nudge(slopes.Nudge(0.0, 0.0))
    with pytest.raises(NoValueError, match=r"it sticks: .* moved it by 0\.09 of the closed form"):
        slopes.check_nudge(slopes.Nudge(0.01, 0.09))


# The closed forms of the experiments, against others.


def test_the_ramp_finds_the_friction_of_its_own_closed_form() -> None:
    shares = 0.3 * np.linspace(0.9, 1.15, 500)
    moved = slopes.distances(shares, 0.02, 0.27)
    assert slopes.friction_of_ramp(shares, 0.02, moved) == pytest.approx(0.27, rel=1e-9)


def test_a_light_strip_over_a_cylinder_is_eulers() -> None:
    """Nothing of it on the cylinder: a = g (heavy - light e) / (heavy + light e)."""
    hanging = capstan.Hanging(1e-9, 0.1, 0.4)
    euler = np.exp(0.3 * np.pi)
    exact = 9.81 * (0.4 - 0.1 * euler) / (0.4 + 0.1 * euler)
    assert capstan.acceleration(0.3, 0.0, 0.0, hanging) == pytest.approx(exact, rel=1e-6)


def test_the_ring_plate_is_a_cantilever_if_it_is_narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drape, "DISC", 0.0999)
    sag = drape.profile(np.array([drape.SHEET]))[0]
    load = drape.LIGHT * 9.81 * drape.DENSITY / drape.BENDING
    assert sag == pytest.approx(load * 1e-4**4 / 8.0, rel=2e-3)


def test_the_drawn_cantilever_has_the_sag_of_the_master_curve() -> None:
    x, z = strips.heavy_line()
    assert strips.weight_of(-z[-1] / x[-1]) == pytest.approx(strips.GAMMA, rel=1e-4)


@pytest.mark.parametrize("gamma", [1.0, 10.0, 200.0])
def test_the_elastica_is_the_master_curve(gamma: float) -> None:
    exact = float(master_curves.cantilever(gamma))
    assert strips.master(gamma) == pytest.approx(exact, rel=1e-9)


def test_the_buckling_weight_is_the_master_curve() -> None:
    exact = float(master_curves.lateral_buckling(strips.ASPECT, 0.0))
    assert pytest.approx(exact, rel=1e-7) == strips.BUCKLING
