"""Fits of a scene's parameters to noisy observations of a run, and what is refused."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
import pytest

from stickslip_sim_core import fit as fitting
from stickslip_sim_core import observations
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.fit import Compared, Observation, Prior, fit
from stickslip_sim_core.observations import (
    MarkedPixels,
    Silhouettes,
    Vertices,
    View,
    mask_outline,
    outline,
)
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter
from stickslip_sim_core.scenes.holders import Hang
from stickslip_sim_core.scenes.scene import ClothRun, Scene

pytestmark = pytest.mark.physics

FRAMES = (2, 4, 5)
TRUTH = {"mu": 0.3}
ALL = np.arange(25)
SLOPE = np.deg2rad(25.0)
VIEW = View(
    np.array([[500.0, 0.0, -100.0, 100.0], [0.0, 500.0, -100.0, 100.0], [0.0, 0.0, -1.0, 1.0]])
)
"""Looks at the cloth along -z from 1 m above it."""
TURN_MIDDLE = np.array([100.0, 100.0])
"""Pixel about which the camera of masks is turned."""


def sliding_sheet(values: Mapping[str, float], _hang: Hang) -> Scene:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    down = np.tile(GRAVITY * np.array([np.sin(SLOPE), 0.0, -np.cos(SLOPE)]), (25, 1))
    bodies = [plane(values["mu"])]
    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock").scaled(bending=values["bending"])],
        preset=preset_named("certified"),
        start=np.column_stack([mesh.rest, np.zeros(25)]),
        motion=lambda _time: (down, bodies),
        frames=6,
        frame_rate=20.0,
    )


@pytest.fixture(scope="module")
def scenes() -> SceneFamily:
    """A sheet that slides down a slope: x = g (sin a - mu cos a) t^2/2."""
    return SceneFamily(
        {"mu": SceneParameter(0.2, 0.0, 0.4), "bending": SceneParameter(1.0, 0.1, 10.0)},
        sliding_sheet,
    )


@pytest.fixture(scope="module")
def run(scenes: SceneFamily) -> ClothRun:
    return scenes.scene(**TRUTH).run()


def noisy(values: Floats, noise: float) -> Floats:
    return values + noise * np.random.default_rng(3).standard_normal(values.shape)


def vertices(run: ClothRun, noise: float = 1e-4) -> Vertices:
    return Vertices(FRAMES, noisy(run.positions[list(FRAMES)], noise), ALL, noise)


def pixels(run: ClothRun) -> MarkedPixels:
    projected = VIEW.project(run.positions[list(FRAMES)])
    return MarkedPixels(FRAMES, noisy(projected, 0.05), ALL, VIEW, 0.05)


def silhouettes(run: ClothRun) -> Silhouettes:
    """Return the middles of the edges of outlines."""
    outlines = []
    for frame in FRAMES:
        projected = VIEW.project(run.positions[frame])
        edges, _ = outline(projected, run.triangles)
        outlines.append(noisy(projected[edges].mean(axis=1), 0.05))
    return Silhouettes(FRAMES, outlines, VIEW, 0.05)


def masks(run: ClothRun) -> Silhouettes:
    """Return the silhouettes of pictures of the flat sheet, by the middles of their pixels.

    The camera is turned, so that edges cross rows of pixels at all places.
    """
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(0.35), -np.sin(0.35)], [np.sin(0.35), np.cos(0.35)]]
    turn[:2, 2] = TURN_MIDDLE - turn[:2, :2] @ TURN_MIDDLE
    rows, columns = np.mgrid[:200, :200]
    upright = np.stack([columns, rows], axis=-1) - TURN_MIDDLE
    upright = upright @ turn[:2, :2] + TURN_MIDDLE
    pictures = []
    for frame in FRAMES:
        projected = VIEW.project(run.positions[frame])
        low, high = projected.min(axis=0), projected.max(axis=0)
        pictures.append(((upright > low) & (upright < high)).all(axis=-1))
    return Silhouettes.of_masks(FRAMES, np.stack(pictures), View(turn @ VIEW.matrix))


@pytest.mark.parametrize("observe", [vertices, pixels, silhouettes])
def test_parameters_are_found(scenes: SceneFamily, run: ClothRun, observe: Any) -> None:
    answer = fit(scenes, [observe(run)], ["mu"])
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * answer.deviations["mu"]
    assert 0.0 < answer.deviations["mu"] < 1e-2
    assert answer.warning == ""
    assert 0.5 < answer.mean_square < 1.5
    assert answer.runs <= 8


def test_friction_is_found_from_masks(scenes: SceneFamily, run: ClothRun) -> None:
    answer = fit(scenes, [masks(run)], ["mu"])
    pixels_by_mu = VIEW.project_change(
        run.positions[-1], scenes.differentiated(["mu"]).run().sensitivities["mu"].positions[-1]
    )
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 0.1 / np.abs(pixels_by_mu).max()
    assert answer.warning == ""


def test_an_outline_of_a_mask_is_between_pixels_that_show_what_they_do() -> None:
    mask = np.zeros((6, 8), bool)
    mask[2:4, 3:8] = True
    hidden = np.zeros_like(mask)
    hidden[1, 4] = True
    points = mask_outline(mask, hidden).tolist()
    # The border of the picture at column 7, and the hidden pixel above (4, 2), are no outline.
    across = [[2.5, row] for row in (2, 3)]
    above = [[column, 1.5] for column in (3, 5, 6, 7)]
    below = [[column, 3.5] for column in (3, 4, 5, 6, 7)]
    assert sorted(points) == sorted(across + above + below)


def test_outline_of_a_folded_sheet_bounds_all_of_it(run: ClothRun) -> None:
    # The right half lies on the left one, and sticks out below it by 1 px.
    folded = VIEW.project(run.positions[0])
    middle = folded[:, 0].mean()
    is_right = folded[:, 0] > middle + 1e-6
    folded[is_right] = np.array([2.0 * middle, 1.0]) + folded[is_right] * [-1.0, 1.0]
    edges, normals = outline(folded, run.triangles)
    ends = folded[edges]
    low, high = folded.min(axis=0), folded.max(axis=0)
    is_lowest = (ends[:, :, 1] > high[1] - 1e-6).all(axis=1)
    assert normals[is_lowest] == pytest.approx(np.tile([0.0, 1.0], (is_lowest.sum(), 1)))
    # The fold and the free edge on it bound the picture on both sides.
    assert ends[:, :, 0].min() == pytest.approx(low[0])
    assert ends[:, :, 0].max() == pytest.approx(high[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"masks": np.zeros((3, 4, 4))}, "masks: must be booleans .* of 3 frames, got float64"),
        ({"masks": np.zeros((2, 4, 4), bool)}, "masks: must be booleans .* of 3 frames"),
        ({"hidden": np.zeros((3, 4, 5), bool)}, "hidden: must be booleans"),
        ({}, "masks: must show an outline of cloth in each frame, and do not in frame 2"),
    ],
)
def test_wrong_masks_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"masks": np.zeros((3, 4, 4), bool), "view": VIEW, **changes}
    with pytest.raises(ValueError, match=message):
        Silhouettes.of_masks(FRAMES, **arguments)


def test_a_view_of_a_camera_projects_as_its_numbers_say() -> None:
    view = View.of_camera(
        fx=100.0,
        fy=200.0,
        cx=10.0,
        cy=20.0,
        rotation=[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        translation=[0.0, 0.0, 2.0],
    )
    assert view.project(np.array([0.5, 0.25, 0.0])) == pytest.approx([22.5, -30.0])


def test_a_prior_weighs_as_an_observation(scenes: SceneFamily, run: ClothRun) -> None:
    observation = vertices(run)
    alone = fit(scenes, [observation], ["mu"])
    # A prior as narrow as the answer is uncertain, and 4 of its deviations off.
    width = alone.by_noise["mu"] / alone.values["mu"]
    median = alone.values["mu"] * float(np.exp(4.0 * width))
    both = fit(scenes, [observation], ["mu"], priors={"mu": Prior(median, width)})
    middle = 0.5 * (alone.values["mu"] + median)
    assert both.values["mu"] == pytest.approx(middle, abs=0.2 * alone.by_noise["mu"])
    assert both.by_noise["mu"] == pytest.approx(alone.by_noise["mu"] / 2.0**0.5, rel=0.2)


def test_a_prior_holds_what_is_not_seen(scenes: SceneFamily, run: ClothRun) -> None:
    answer = fit(scenes, [vertices(run)], ["mu", "bending"], priors={"bending": Prior(2.0, 0.5)})
    assert answer.values["bending"] == pytest.approx(2.0, rel=0.05)
    assert answer.deviations["bending"] == pytest.approx(1.0, rel=0.1)
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * answer.deviations["mu"]


@pytest.mark.parametrize("observe", [vertices, pixels, silhouettes])
def test_jacobians_are_those_of_residuals(scenes: SceneFamily, run: ClothRun, observe: Any) -> None:
    observation: Observation = observe(run)
    changes = np.random.default_rng(5).standard_normal(run.positions.shape)
    h = 1e-7
    moved = [replace(run, positions=run.positions + change * changes) for change in (h, -h)]
    ahead, behind = (observation.compare(each, []).residual for each in moved)
    difference = (ahead - behind) / (2.0 * h)
    by = observation.compare(run, [changes]).jacobian[:, 0]
    assert by == pytest.approx(difference, rel=1e-3, abs=1e-3 * float(np.abs(by).max()))


def test_derivatives_share_the_search_for_an_outline(
    run: ClothRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    observation = silhouettes(run)
    searched = []

    def counted(*arguments: Any) -> Any:
        searched.append(arguments)
        return outline(*arguments)

    monkeypatch.setattr(observations, "outline", counted)
    by = observation.compare(run, 3 * [np.ones_like(run.positions)]).jacobian
    assert by.shape == (observation.count, 3)
    assert len(searched) == len(FRAMES)


@dataclass(frozen=True)
class Jumping(Vertices):
    """Vertices whose residual jumps between near values, as steps of a solver make it."""

    seed: int = 0

    def compare(self, run: ClothRun, derivatives: Sequence[Floats]) -> Compared:
        compared = super().compare(run, derivatives)
        digits = (int(1e12 * float(np.abs(run.positions).sum())) + self.seed) % 2**32
        jumps = 0.05 * np.random.default_rng(digits).standard_normal(compared.residual.shape)
        return compared._replace(residual=compared.residual + jumps)


def test_a_search_does_not_follow_jumps_within_the_noise(
    scenes: SceneFamily, run: ClothRun
) -> None:
    smooth = vertices(run)
    runs = []
    for seed in range(5):
        jumping = Jumping(FRAMES, smooth.positions, ALL, smooth.noise, seed)
        answer = fit(scenes, [jumping], ["mu"])
        runs.append(answer.runs)
        assert answer.converged
        assert answer.warning == ""
        assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * answer.deviations["mu"]
    # A jump may lead a search astray once. A search that waits for a decrease of the residual
    # takes 9 runs.
    assert median(runs) <= 8


def test_runs_near_the_minimum_repeat_the_steps_of_one_run(
    scenes: SceneFamily, run: ClothRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    repeated: list[Floats | None] = []
    chosen: list[Floats] = []
    simulate = Scene.run

    def recorded(scene: Scene) -> ClothRun:
        result = simulate(scene)
        repeated.append(scene.step_ends)
        chosen.append(result.step_ends)
        return result

    monkeypatch.setattr(Scene, "run", recorded)
    # A low start is far enough for runs with free steps before the others.
    answer = fit(scenes, [vertices(run)], ["mu"], start={"mu": 0.05})
    # The last run has finer steps of its own.
    assert answer.runs == len(repeated) - 1
    assert repeated[0] is None
    assert repeated[-1] is None
    begin = next(number for number, steps in enumerate(repeated) if steps is not None)
    assert all(steps is not None for steps in repeated[begin:-1])
    assert all(np.array_equal(steps, chosen[begin - 1]) for steps in chosen[begin:-1])


def test_a_fit_that_leaves_a_residual_says_so(scenes: SceneFamily, run: ClothRun) -> None:
    # No friction within the bounds moves the cloth as this one did.
    answer = fit(scenes, [vertices(run)], ["mu"], bounds={"mu": (0.1, 0.25)}, multistart=2)
    assert answer.mean_square > 1.5
    assert len(answer.searches) == 2
    # Both searches end at the bound, which is one minimum.
    assert answer.warning.startswith(
        "the searches from 2 starts ended in 1 minimum: the best leaves"
    )


def test_without_scipy_a_fit_says_how_to_get_it(
    scenes: SceneFamily, run: ClothRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fitting, "find_spec", lambda _name: None)
    with pytest.raises(ImportError, match=r"pip install './sim_core\[fit\]'"):
        fit(scenes, [vertices(run)], ["mu"])


def test_deviations_have_the_errors_of_steps(scenes: SceneFamily) -> None:
    # Air that damps the slide costs implicit Euler an error of first order in the step.
    fine = damped(scenes, 0.05 / 16.0).scene(**TRUTH).run()
    answer = fit(damped(scenes, 0.05), [vertices(fine)], ["mu"])
    off = abs(answer.values["mu"] - TRUTH["mu"])
    assert off > 10.0 * answer.by_noise["mu"]
    assert off < 1.5 * answer.by_steps["mu"]
    assert answer.deviations["mu"] >= answer.by_steps["mu"]


def damped(scenes: SceneFamily, step: float) -> SceneFamily:
    """Return the scenes in air that damps, with steps of one length [s]."""
    settings = replace(
        preset_named("certified"), time_step=step, step_error=None, second_order=False
    )

    def make(values: Mapping[str, float], hang: Hang) -> Scene:
        return replace(scenes.make(values, hang), preset=settings, damping=lambda _time: 5.0)

    return replace(scenes, make=make)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": []}, "parameters: must be at least one"),
        ({"parameters": ["my"]}, "must be one of mu"),
        ({"multistart": 0}, "multistart: must be 1 or more"),
        ({"start": {"mu": 20.0}}, r"mu: must be within 0 \.\.\. 0\.4"),
        ({"bounds": {"density": (0.5, 2.0)}}, "bounds: must be of mu"),
        ({"priors": {"density": Prior(1.0, 0.5)}}, "priors: must be of mu"),
        ({"bounds": {"mu": (0.3, 0.2)}}, "bounds: of mu must ascend"),
        ({"bounds": {"mu": (0.3, 0.4)}, "start": {"mu": 0.2}}, "start: must be within the bounds"),
    ],
)
def test_wrong_arguments_are_refused(
    scenes: SceneFamily, run: ClothRun, changes: dict[str, Any], message: str
) -> None:
    arguments: dict[str, Any] = {"parameters": ["mu"], **changes}
    names = arguments.pop("parameters")
    with pytest.raises(ValueError, match=message):
        fit(scenes, [vertices(run)], names, **arguments)


@pytest.mark.parametrize("numbers", [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (1.0, np.nan)])
def test_priors_without_positive_numbers_are_refused(numbers: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"median|deviation"):
        Prior(*numbers)


def test_fewer_observations_than_parameters_are_refused(scenes: SceneFamily) -> None:
    with pytest.raises(ValueError, match="at least as many numbers as parameters, 2, got 0"):
        fit(scenes, [], ["mu", "bending"])


def test_parameter_without_effect_is_refused(scenes: SceneFamily, run: ClothRun) -> None:
    # The first frame is the start.
    early = Vertices([0], run.positions[[0]], ALL, 1e-4)
    with pytest.raises(ValueError, match="mu has no effect on the observations"):
        fit(scenes, [early], ["mu"])


def test_effect_of_rounding_counts_as_none(scenes: SceneFamily, run: ClothRun) -> None:
    # The sheet slides as a whole, and derivatives by bending are of rounding.
    with pytest.raises(ValueError, match="bending has no effect on the observations"):
        fit(scenes, [vertices(run)], ["mu", "bending"])


def test_fit_goes_on_where_the_first_start_sticks(scenes: SceneFamily, run: ClothRun) -> None:
    wide = {**scenes.parameters, "mu": SceneParameter(0.6, 0.05, 1.0)}
    answer = fit(replace(scenes, parameters=wide), [vertices(run)], ["mu"])
    assert "mu has no effect" in answer.searches[0].message
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * answer.deviations["mu"]
    assert answer.warning == ""


def test_fit_goes_on_with_another_family(scenes: SceneFamily, run: ClothRun) -> None:
    def uphill(values: Mapping[str, float], hang: Hang) -> Scene:
        scene = sliding_sheet(values, hang)
        up = np.tile(GRAVITY * np.array([-np.sin(SLOPE), 0.0, -np.cos(SLOPE)]), (25, 1))
        bodies = [plane(values["mu"])]
        return replace(scene, motion=lambda _time: (up, bodies))

    other_way = replace(scenes, make=uphill)
    answer = fit([other_way, scenes], [vertices(run)], ["mu"], multistart=1)
    assert answer.family == 1
    assert [search.family for search in answer.searches] == [0, 1]
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * answer.deviations["mu"]
    # The right one comes first: no other is searched.
    assert len(fit([scenes, other_way], [vertices(run)], ["mu"]).searches) == 1
    with pytest.raises(ValueError, match="scenes: must be at least one family, got none"):
        fit([], [vertices(run)], ["mu"])


def test_warning_of_one_search_is_in_the_singular(scenes: SceneFamily, run: ClothRun) -> None:
    answer = fit(scenes, [vertices(run)], ["mu"], bounds={"mu": (0.1, 0.25)}, multistart=1)
    assert answer.warning.startswith("the search from 1 start ended in 1 minimum: ")


def test_observations_of_other_frames_are_refused(scenes: SceneFamily, run: ClothRun) -> None:
    late = Vertices([6], run.positions[[5]], ALL, 1e-4)
    with pytest.raises(ValueError, match=r"frames: must be within 0 \.\.\. 5"):
        fit(scenes, [late], ["mu"])


def test_observations_that_are_no_numbers_are_refused(run: ClothRun) -> None:
    positions = run.positions[list(FRAMES)].copy()
    positions[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match=r"positions: must be finite, and is not at \(1, 2, 0\)"):
        Vertices(FRAMES, positions, ALL, 1e-4)
    with pytest.raises(ValueError, match=r"positions: must have the shape \(3, 24, 3\)"):
        Vertices(FRAMES, run.positions[list(FRAMES)], ALL[:24], 1e-4)
