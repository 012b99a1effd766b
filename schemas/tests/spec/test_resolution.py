"""Pictures of any size: what a spec may ask for, and what follows in cameras, arrays and keys."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from stickslip_schemas.base import Stage
from stickslip_schemas.documents.problems import FieldError, field_errors
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import count, estimate_cost
from stickslip_schemas.plan.points import keyed_points
from stickslip_schemas.scene.library import load_scene
from stickslip_schemas.spec.cameras import framed, load_rig
from stickslip_schemas.spec.names import Calibration
from stickslip_schemas.spec.resolution import CLIP_PIXELS_MAX

SIZES = [(640, 480), (128, 128), (1280, 720), (360, 640), (641, 99)]
BUILDS = Builds(sim_core="1" * 64, simulate="2" * 64, render="3" * 64, pack="4" * 64)
LAB: dict[str, Any] = {
    "image_size": [640, 480],
    "camera_matrix": [[700.0, 0.0, 322.5], [0.0, 705.0, 237.5], [0.0, 0.0, 1.0]],
    "rvec": [np.pi / 2, 0.0, 0.0],
    "tvec": [0.0, 0.2, 1.0],
}
DRAG: dict[str, Any] = {
    "kind": "cloth_drag",
    "axes": {
        "material": "gray-interlock",
        "mu": 0.3,
        "texture": "dots",
        "viewpoint": ["left", "lab"],
    },
    "viewpoints": {"lab": LAB},
    "ground_truth": ["depth"],
}
ROD: dict[str, Any] = {"kind": "rod_hang", "axes": {"gamma": 1.0, "phi0": 0.0, "phi1": 1.0}}
SCENE: dict[str, Any] = {
    "kind": "cloth_scene",
    "scene": "peg",
    "axes": {"texture": "dots", "viewpoint": "high"},
}


def _spec(document: dict[str, Any], **more: Any) -> Any:
    return job_spec_adapter.validate_python(document | more)


def _error(document: dict[str, Any], **more: Any) -> FieldError:
    """Return the one error of a spec that is refused."""
    with pytest.raises(ValidationError) as raised:
        _spec(document, **more)
    (error,) = field_errors(raised.value, document | more, AnyJobSpec)
    return error


def _shape(spec: Any, name: str) -> tuple[int, ...]:
    return next(array.shape for array in layout(spec) if array.name == name)


@pytest.mark.parametrize(
    "value",
    [
        640,
        "640x480",
        [640],
        [640, 480, 3],
        [640.5, 480],
        [63, 480],
        [1921, 480],
        [True, 480],
        [float("inf"), 480],
        [float("nan"), 480],
        ["640", 480],
        {"width": 640},
    ],
)
@pytest.mark.parametrize("document", [DRAG, ROD, SCENE], ids=["drag", "rod", "scene"])
def test_a_wrong_size_names_its_field_rule_and_remedy(document: Any, value: Any) -> None:
    error = _error(document, resolution=value)
    assert error.pointer == "/resolution"
    assert error.rule == (
        "must be [width, height], two whole numbers from 64 to 1920 pixels, for example [640, 480]"
    )


def test_a_camera_with_a_wrong_size_is_named() -> None:
    error = _error(DRAG, viewpoints={"lab": LAB | {"resolution": [10, 10]}})
    assert error.pointer == "/viewpoints/lab/resolution"


def test_a_clip_that_does_not_fit_in_memory_is_refused_with_the_frames_that_do() -> None:
    most = CLIP_PIXELS_MAX // (1280 * 720)
    assert _shape(_spec(DRAG, resolution=[1280, 720], frames=most), "video")[0] == most
    with pytest.raises(ValidationError, match=f"Set frames to {most} or fewer"):
        _spec(DRAG, resolution=[1280, 720], frames=most + 1)


def test_the_default_is_left_out_of_documents_and_keys() -> None:
    """So a spec that says nothing and one that says the default are one dataset."""
    for document in (DRAG, ROD, SCENE):
        default = _spec(document)
        explicit = _spec(document, resolution=[224, 224])
        assert explicit.content_digest == default.content_digest
        assert "resolution" not in default.model_dump(mode="json")
        renders = [next(keyed_points(spec, BUILDS)).render_text for spec in (default, explicit)]
        assert renders[0] == renders[1]
        assert "resolution" not in str(renders[0])
        larger = _spec(document, resolution=[640, 480])
        assert larger.content_digest != default.content_digest
        assert _spec(larger.model_dump(mode="json")).content_digest == larger.content_digest
        assert next(keyed_points(larger, BUILDS)).render_text != renders[0]


@pytest.mark.parametrize("size", SIZES)
def test_arrays_and_cameras_have_the_size(size: tuple[int, int]) -> None:
    width, height = size
    drag = _spec(DRAG, resolution=size)
    assert _shape(drag, "video") == (30, height, width, 3)
    assert _shape(drag, "depth") == (30, height, width)
    assert {(camera.width, camera.height) for camera in drag.cameras()} == {size}
    assert _shape(_spec(SCENE, resolution=size), "video") == (30, height, width, 3)
    rod = _spec(ROD, resolution=size)
    assert _shape(rod, "views") == (4, height, width, 3)
    assert {(camera.width, camera.height) for camera in rod.cameras()} == {size}


@pytest.mark.parametrize("size", SIZES)
def test_a_camera_of_a_rig_keeps_all_that_it_sees(size: tuple[int, int]) -> None:
    """The shorter side shows what it showed before, the other one at least as much."""
    width, height = size
    for camera in (*load_rig("drag"), *load_rig("rod-4")):
        resized = camera.resized(size)
        assert (resized.width, resized.height) == size
        assert resized.numbers[4:] == camera.numbers[4:]
        scale = min(size) / 224
        # The edges of the square are the edges of the largest square in the middle.
        for corner in ((-0.5, -0.5), (223.5, 223.5)):
            x, y = (corner[0] - camera.cx) / camera.fx, (corner[1] - camera.cy) / camera.fy
            u, v = resized.fx * x + resized.cx, resized.fy * y + resized.cy
            middle = np.array([width - 1, height - 1]) / 2
            np.testing.assert_allclose(
                [u, v], middle + scale * (np.array(corner) - 111.5), atol=1e-9
            )


@pytest.mark.parametrize("size", SIZES)
def test_a_framing_camera_touches_its_margin(size: tuple[int, int]) -> None:
    points = np.random.Generator(np.random.PCG64(5)).uniform(-0.2, 0.2, (200, 3))
    camera = framed("front", points, size=size)
    margin = 10 * min(size) / 224
    # It is counted from the middle of the outermost pixels.
    assert camera.overflow(points) == pytest.approx(-margin - 0.5, abs=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_a_calibrated_camera_shows_the_largest_part_of_its_image(size: tuple[int, int]) -> None:
    """Edges of pixels go onto edges, and at least one side of the image is there whole."""
    camera = Calibration.model_validate(LAB).camera("lab", size)
    width, height = size
    scale = max(width / 640, height / 480)
    np.testing.assert_allclose([camera.fx, camera.fy], [700 * scale, 705 * scale])
    point = np.array([[0.05, 0.1, 0.12]])
    pixels, _ = camera.project(point)
    x = point[0] @ np.asarray(camera.rotation).T + np.asarray(LAB["tvec"])
    u, v = 700.0 * x[0] / x[2] + 322.5, 705.0 * x[1] / x[2] + 237.5
    left, top = (640 - width / scale) / 2, (480 - height / scale) / 2
    expected = [(u + 0.5 - left) * scale - 0.5, (v + 0.5 - top) * scale - 0.5]
    np.testing.assert_allclose(pixels[0], expected)
    assert min(abs(left), abs(top)) < 1e-9


def test_the_size_of_the_image_gives_the_calibrated_camera_itself() -> None:
    camera = Calibration.model_validate(LAB | {"resolution": [640, 480]}).camera("lab")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (700.0, 705.0, 322.5, 237.5)


def test_a_lens_is_checked_over_the_picture_that_the_spec_asks_for() -> None:
    """A lens that folds beyond the middle square: only wide pictures show it."""
    lens = {"distortion": [-0.6, 0.0, 0.0, 0.0, 0.0]}
    assert _spec(DRAG, viewpoints={"lab": LAB | lens})
    error = _error(DRAG, viewpoints={"lab": LAB | lens}, resolution=[640, 360])
    assert error.pointer == "/viewpoints/lab"
    assert "over the whole picture of 640 x 360 pixels" in error.rule


def test_pictures_of_several_sizes_share_frames_of_the_largest() -> None:
    spec = _spec(DRAG, resolution=[128, 128], viewpoints={"lab": LAB | {"resolution": [320, 96]}})
    assert _shape(spec, "video") == (30, 128, 320, 3)
    assert _shape(spec, "picture_size") == (2,)
    sizes = {camera.name: (camera.width, camera.height) for camera in spec.cameras()}
    assert (sizes["left"], sizes["lab"]) == ((128, 128), (320, 96))
    left, lab = (spec.render(point) for point in spec.grid())
    assert (left.picture_size, lab.picture_size) == ((128, 128), (320, 96))
    assert left.canvas == lab.canvas == (320, 128)


def _with_cameras(**more: Any) -> dict[str, Any]:
    """Return a spec of a scene with two cameras of its own; the second one has more keys."""
    scene = load_scene("peg").model_dump(mode="json", exclude_unset=True)
    near: dict[str, Any] = {"position": [0.3, -0.6, 0.9], "target": [0.0, 0.0, 0.2]}
    far: dict[str, Any] = {"position": [0.6, -1.2, 1.8], "target": [0.0, 0.0, 0.2]}
    scene.setdefault("looks", {})["cameras"] = {"near": near, "far": far | more}
    axes = {"texture": "dots", "viewpoint": ["near", "far"]}
    return SCENE | {"scene": scene, "axes": axes, "ground_truth": ["depth"]}


def test_a_camera_of_a_scene_may_have_its_size() -> None:
    spec = _spec(_with_cameras(resolution=[320, 96]), resolution=[128, 128])
    assert _shape(spec, "video")[1:] == (*_shape(spec, "depth")[1:], 3) == (128, 320, 3)
    assert _shape(spec, "picture_size") == (2,)
    sizes = {camera.name: (camera.width, camera.height) for camera in spec.cameras()}
    assert sizes == {"near": (128, 128), "far": (320, 96)}
    near, far = (spec.render(point) for point in spec.grid())
    assert (near.picture_size, far.picture_size) == ((128, 128), (320, 96))
    assert near.canvas == far.canvas == (320, 128)
    # The shorter side shows the same angle: the focal length is one for a film of 36 mm.
    focal = {camera.name: camera.fx / min(sizes[camera.name]) for camera in spec.cameras()}
    assert focal["near"] == pytest.approx(focal["far"])


def test_a_camera_of_a_scene_without_a_size_keeps_the_digest_of_its_spec() -> None:
    plain = _spec(_with_cameras())
    explicit = _spec(_with_cameras(resolution=None))
    assert plain.content_digest == explicit.content_digest
    assert "resolution" not in str(plain.model_dump(mode="json"))


def test_a_camera_of_a_scene_with_a_wrong_size_is_named() -> None:
    document = _with_cameras(resolution=[10, 10])
    with pytest.raises(ValidationError) as raised:
        _spec(document)
    # A rig is possible, too, so there is another error beside this one.
    rules = {e.pointer: e.rule for e in field_errors(raised.value, document, AnyJobSpec)}
    assert "must be [width, height]" in rules["/scene/looks/cameras/far/resolution"]


def test_a_viewpoint_that_no_sample_has_changes_no_array() -> None:
    axes = DRAG["axes"] | {"viewpoint": "left"}
    viewpoints = {"lab": LAB | {"resolution": [320, 96]}}
    spec = _spec(DRAG, axes=axes, viewpoints=viewpoints)
    assert _shape(spec, "video") == (30, 224, 224, 3)
    assert spec.render(next(spec.grid())).canvas is None


def test_cost_grows_with_pixels() -> None:
    costs = []
    groups = set()
    for size in ([224, 224], [640, 480], [1280, 720]):
        spec = _spec(DRAG, resolution=size)
        costs.append(estimate_cost(spec, count(spec), {}, 1).stages[Stage.render].median)
        groups.add(spec.cost_group(Stage.render, next(spec.grid())))
    # Measured: a shading of 640 x 480 takes 4 to 5 times as long as that of the default.
    assert 3.5 < costs[1] / costs[0] < 5.5
    assert costs[2] > 2 * costs[1]
    assert groups == {
        "standard, 30 frames",
        "standard, 30 frames, 640 x 480",
        "standard, 30 frames, 1280 x 720",
    }


def test_cost_of_rods_grows_with_the_shorter_side() -> None:
    costs = [_spec(ROD, resolution=size).default_costs.render for size in ([224, 224], [640, 448])]
    assert costs[1] / costs[0] == pytest.approx(4.0)
