"""Fits of a scene's parameters to noisy observations of a run, and what is refused."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.fit import Observation, fit
from stickslip_sim_core.observations import MarkedPixels, Silhouettes, Vertices, View, outline
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


@pytest.mark.parametrize("observe", [vertices, pixels, silhouettes])
def test_parameters_are_found(scenes: SceneFamily, run: ClothRun, observe: Any) -> None:
    answer = fit(scenes, [observe(run)], ["mu"])
    assert abs(answer.values["mu"] - TRUTH["mu"]) < 4.0 * answer.deviations["mu"]
    assert 0.0 < answer.deviations["mu"] < 1e-2
    assert answer.warning == ""
    assert 0.5 < answer.mean_square < 1.5
    assert answer.runs <= 8


@pytest.mark.parametrize("observe", [vertices, pixels, silhouettes])
def test_jacobians_are_those_of_residuals(scenes: SceneFamily, run: ClothRun, observe: Any) -> None:
    observation: Observation = observe(run)
    changes = np.random.default_rng(5).standard_normal(run.positions.shape)
    h = 1e-7
    moved = [replace(run, positions=run.positions + change * changes) for change in (h, -h)]
    difference = (observation.residual(moved[0]) - observation.residual(moved[1])) / (2.0 * h)
    by = observation.jacobian(run, changes)
    assert by == pytest.approx(difference, rel=1e-3, abs=1e-3 * float(np.abs(by).max()))


def test_a_fit_that_leaves_a_residual_says_so(scenes: SceneFamily, run: ClothRun) -> None:
    # No friction within the bounds moves the cloth as this one did.
    answer = fit(scenes, [vertices(run)], ["mu"], bounds={"mu": (0.1, 0.25)}, multistart=2)
    assert answer.mean_square > 1.5
    assert len(answer.searches) == 2
    assert answer.warning.startswith("several minima: the searches from 2 starts ended in")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": []}, "parameters: must be at least one"),
        ({"parameters": ["my"]}, "must be one of mu"),
        ({"multistart": 0}, "multistart: must be 1 or more"),
        ({"start": {"mu": 20.0}}, r"mu: must be within 0 \.\.\. 0\.4"),
        ({"bounds": {"density": (0.5, 2.0)}}, "bounds: must be of mu"),
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


def test_fewer_observations_than_parameters_are_refused(scenes: SceneFamily) -> None:
    with pytest.raises(ValueError, match="at least as many numbers as parameters, 2, got 0"):
        fit(scenes, [], ["mu", "bending"])


def test_parameter_without_effect_is_refused(scenes: SceneFamily, run: ClothRun) -> None:
    # The first frame is the start.
    early = Vertices([0], run.positions[[0]], ALL, 1e-4)
    with pytest.raises(ValueError, match="mu has no effect on the observations"):
        fit(scenes, [early], ["mu"])


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
