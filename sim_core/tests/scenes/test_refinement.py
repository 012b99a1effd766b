"""Fits that finer scenes correct, rivals that are weighed, and errors that are not independent."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.fit import Compared, Fit, Prior, fit
from stickslip_sim_core.fit_search import dependence
from stickslip_sim_core.observations import Silhouettes, Vertices, View
from stickslip_sim_core.refinement import (
    ANOTHER_BRANCH,
    MESH_SHARE,
    Refined,
    Target,
    mixed,
    refined,
)
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter
from stickslip_sim_core.scenes.holders import Hang
from stickslip_sim_core.scenes.scene import Scene

pytestmark = pytest.mark.physics

FRAMES = (2, 4, 5)
TRUTH = {"mu": 0.3}
SLOPE = np.deg2rad(25.0)
NOISE = 1e-4
LONG, SHORT = 0.05, 0.0125
"""Steps of the coarse and of the finer scenes [s]: air that damps makes them differ."""


def sliding(step: float, *, sideways: bool = False) -> SceneFamily:
    """Return the scenes of a sheet that slides down a slope, or across it, in air that damps."""

    def make(values: Mapping[str, float], _hang: Hang) -> Scene:
        mesh = meshes.grid(0.1, 0.1, 4, 4)
        vertices = len(mesh.rest)
        down = GRAVITY * np.tile([np.sin(SLOPE), 0.0, -np.cos(SLOPE)], (vertices, 1))
        if sideways:
            down = down[:, [1, 0, 2]]
        bodies = [plane(values["mu"])]
        settings = replace(
            preset_named("certified"), time_step=step, step_error=None, second_order=False
        )
        return Scene(
            mesh=mesh,
            fabrics=[fabric("gray-interlock").scaled(bending=values["bending"])],
            preset=settings,
            start=np.column_stack([mesh.rest, np.zeros(vertices)]),
            motion=lambda _time: (down, bodies),
            damping=lambda _time: 5.0,
            frames=6,
            frame_rate=20.0,
        )

    return SceneFamily(
        {"mu": SceneParameter(0.2, 0.0, 0.4), "bending": SceneParameter(1.0, 0.1, 10.0)}, make
    )


@pytest.fixture(scope="module")
def observed() -> Vertices:
    """Vertices of the finer scene."""
    run = sliding(SHORT).scene(**TRUTH).run()
    true = run.positions[list(FRAMES)]
    noise = NOISE * np.random.default_rng(3).standard_normal(true.shape)
    return Vertices(FRAMES, true + noise, np.arange(true.shape[1]), NOISE)


@pytest.fixture(scope="module")
def coarse(observed: Vertices) -> Fit:
    return fit(sliding(LONG), [observed], ["mu"], multistart=1)


def test_finer_scenes_correct_a_fit(observed: Vertices, coarse: Fit) -> None:
    assert abs(coarse.values["mu"] - TRUTH["mu"]) > 10.0 * coarse.by_noise["mu"]
    targets = {"same": Target(sliding(LONG)), "finer": Target(sliding(SHORT), MESH_SHARE)}
    answers = refined(coarse, sliding(LONG), targets, [observed], ["mu"])
    # The minimum of the fitted scenes is where it was.
    assert answers["same"].values["mu"] == pytest.approx(coarse.values["mu"], abs=1e-4)
    assert answers["same"].by_mesh["mu"] == 0.0
    answer = answers["finer"]
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * coarse.by_noise["mu"]
    assert answer.mean_square < 1.5
    assert answer.runs <= 4
    # A third of the way from the coarse minimum.
    way = abs(answer.values["mu"] - coarse.values["mu"])
    assert answer.by_mesh["mu"] == pytest.approx(way / 3.0, rel=0.2)
    assert answer.deviations["mu"] > answer.by_mesh["mu"]


def test_what_a_prior_alone_knows_may_come_with_the_finer_scenes(
    observed: Vertices, coarse: Fit
) -> None:
    priors = {"bending": Prior(2.0, 0.5)}
    names = ["mu", "bending"]
    targets = {"finer": Target(sliding(SHORT))}
    answer = refined(coarse, sliding(LONG), targets, [observed], names, priors=priors)["finer"]
    assert answer.values["bending"] == pytest.approx(2.0, rel=0.05)
    assert answer.deviations["bending"] == pytest.approx(1.0, rel=0.1)
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * coarse.by_noise["mu"]


def test_finer_cloth_on_another_side_corrects_nothing(observed: Vertices, coarse: Fit) -> None:
    targets = {"finer": Target(sliding(SHORT, sideways=True))}
    answer = refined(coarse, sliding(LONG), targets, [observed], ["mu"])["finer"]
    assert answer.values == coarse.values
    assert answer.mean_square > 10.0 * coarse.mean_square
    assert answer.warning == ANOTHER_BRANCH


def rival(mu: float, deviation: float, mean_square: float) -> Refined:
    covariance = np.array([[deviation**2]])
    none = {"mu": 0.0}
    return Refined({"mu": mu}, covariance, none, none, mean_square, 100.0, 1, "")


def test_rivals_that_leave_the_same_weigh_as_before() -> None:
    answer = mixed([rival(0.2, 0.01, 0.7), rival(0.4, 0.01, 0.7)], [0.75, 0.25])
    assert answer.weights == pytest.approx([0.75, 0.25])
    assert answer.values["mu"] == pytest.approx(0.25)
    # The variance among both is 0.75 x 0.25 x 0.2^2.
    assert answer.deviations["mu"] == pytest.approx((0.01**2 + 0.0075) ** 0.5)


def test_a_rival_that_leaves_more_weighs_less() -> None:
    # 100 numbers leave 4 % more: half of 4 in the logarithm.
    answer = mixed([rival(0.2, 0.01, 2.0), rival(0.4, 0.01, 2.08)], [0.5, 0.5])
    assert answer.weights[1] / answer.weights[0] == pytest.approx(np.exp(-2.0))


@pytest.mark.parametrize("probabilities", [[], [0.5], [1.0, 0.0]])
def test_rivals_without_probabilities_are_refused(probabilities: list[float]) -> None:
    with pytest.raises(ValueError, match="probabilities: must be a positive one for each of 2"):
        mixed([rival(0.2, 0.01, 1.0), rival(0.4, 0.01, 1.0)], probabilities)


def test_no_rivals_are_refused() -> None:
    with pytest.raises(ValueError, match="for each of 0 rivals"):
        mixed([], [])


def with_groups(errors: Floats) -> Compared:
    return Compared(errors.ravel(), np.ones((errors.size, 1)), np.arange(errors.size) // 10)


def test_errors_that_are_one_count_once() -> None:
    rng = np.random.default_rng(2)
    independent = rng.standard_normal((4000, 10))
    assert dependence(with_groups(independent)) == pytest.approx(1.0, abs=0.1)
    # Five neighbours have the same error.
    shared = np.repeat(rng.standard_normal((4000, 2)), 5, axis=1)
    assert dependence(with_groups(shared)) == pytest.approx(5.0, rel=0.1)
    assert dependence(with_groups(np.zeros((1, 10)))) == 1.0
    assert dependence(Compared(shared.ravel(), np.ones((shared.size, 1)))) == 1.0


def test_points_of_an_outline_in_one_patch_are_one_group() -> None:
    view = View(np.array([[500.0, 0.0, -100.0, 100.0], [0.0, 500.0, -100.0, 100.0], [0, 0, -1, 1]]))
    run = sliding(LONG).scene(**TRUTH).run()
    points = np.array([[1.0, 2.0], [30.0, 31.0], [33.0, 2.0]])
    silhouettes = Silhouettes([0, 1], [points, points], view, 0.3)
    groups = silhouettes.compare(run, []).groups
    assert groups is not None
    # Neither a patch nor a frame shares its errors with another.
    assert groups[0] == groups[1]
    assert len(np.unique(groups)) == 4
