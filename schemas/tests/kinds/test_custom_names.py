"""Custom textures, cameras, lamps and floors of a spec."""

import io
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError
from stickslip_schemas.documents.problems import field_errors
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.format.pictures import MAX_BYTES, UnfitPictureError, read_picture
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.kinds.cloth_drag import VIEWPOINTS, ClothDragRender, ClothDragSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.names import Calibration, Lighting, Substrate, Texture
from stickslip_testing.samples import samples

BUILDS = Builds(sim_core="1" * 64, simulate="2" * 64, render="3" * 64, pack="4" * 64)
LAB: dict[str, Any] = {
    "image_size": [640, 480],
    "camera_matrix": [[700.0, 0.0, 319.5], [0.0, 700.0, 239.5], [0.0, 0.0, 1.0]],
    "rvec": [np.pi / 2, 0.0, 0.0],  # looks along +y, with z up
    "tvec": [0.0, 0.2, 1.0],
}
LAMP = {"azimuth": [10.0, 20.0], "elevation": [40.0, 50.0], "power": [1.0, 1.0]}
FLOOR = {"albedo": [0.2, 0.3], "roughness": [0.5, 0.6]}


def _document(**more: Any) -> dict[str, Any]:
    axes = {
        "material": "gray-interlock",
        "mu": 0.3,
        "texture": ["dots", "logo"],
        "viewpoint": ["left", "lab"],
    }
    return {
        "kind": "cloth_drag",
        "axes": axes | {"lighting": ["drawn", "bench"], "substrate": ["baize", "any"]},
        "textures": {"logo": f"sha256:{'a' * 64}"},
        "viewpoints": {"lab": LAB},
        "lamps": {"bench": LAMP},
        "substrates": {"baize": FLOOR},
        **more,
    }


def _spec(**more: Any) -> ClothDragSpec:
    spec = job_spec_adapter.validate_python(_document(**more))
    assert isinstance(spec, ClothDragSpec)
    return spec


@pytest.mark.parametrize("as_written", [np.transpose, np.array], ids=["columns", "rows"])
def test_arrays_of_opencv_are_taken_as_they_come(as_written: Callable[[Any], Any]) -> None:
    """`solvePnP` returns columns, and `calibrateCamera` a row of distortion coefficients."""
    plain = LAB | {"distortion": [-0.1, 0.02, 0.001, -0.001, 0.0]}
    arrays = {name: as_written([plain[name]]).tolist() for name in ("rvec", "tvec", "distortion")}
    assert np.ndim(arrays["rvec"]) == 2
    assert Calibration(**plain | arrays) == Calibration(**plain)


@pytest.mark.parametrize("rvec", [[[1.0, 0.0], [0.0, 1.0]], [[1.0], 0.0, 0.0], [[1.0, 0.0]], []])
def test_other_shapes_of_vectors_are_refused(rvec: list[Any]) -> None:
    with pytest.raises(ValidationError):
        Calibration(**LAB | {"rvec": rvec})


def test_names_of_the_users_own_are_codes_after_the_built_in_ones() -> None:
    categories = {array.name: array.categories for array in layout(_spec())}
    assert categories["texture"] == (*Texture, "logo")
    assert categories["viewpoint"] == (*VIEWPOINTS, "lab")
    assert categories["lighting"] == (*Lighting, "bench")
    assert categories["substrate"] == (*Substrate, "baize")
    assert [camera.name for camera in _spec().cameras()] == [*VIEWPOINTS, "lab"]
    assert _spec().artifacts == {"/textures/logo": "a" * 64}


def test_documents_hold_what_is_the_users_own_and_nothing_else() -> None:
    for sample in samples(_spec(), BUILDS):
        render, point = sample.render, sample.labels
        assert isinstance(render, ClothDragRender)
        assert render.image == (f"sha256:{'a' * 64}" if point["texture"] == "logo" else None)
        assert render.camera == (
            Calibration(**LAB).camera("lab") if point["viewpoint"] == "lab" else None
        )
        assert (render.lamp is None) == (point["lighting"] == "drawn")
        assert (render.finish is None) == (point["substrate"] == "any")


@pytest.mark.parametrize(
    "change",
    [
        {"textures": {"logo": f"sha256:{'b' * 64}"}},
        {"viewpoints": {"lab": LAB | {"tvec": [0.0, 0.2, 1.1]}}},
        {"lamps": {"bench": LAMP | {"power": [1.0, 1.1]}}},
        {"substrates": {"baize": FLOOR | {"grain": 0.2}}},
    ],
)
def test_every_number_is_in_the_key_of_the_render_and_in_no_other(change: dict[str, Any]) -> None:
    before, after = list(samples(_spec(), BUILDS)), list(samples(_spec(**change), BUILDS))
    assert [sample.simulation_key for sample in before] == [
        sample.simulation_key for sample in after
    ]
    changed = [
        original.render_key != other.render_key
        for original, other in zip(before, after, strict=True)
    ]
    assert sum(changed) == len(changed) / 2  # those of one of two names


def _errors(document: dict[str, Any]) -> dict[str, str]:
    with pytest.raises(ValidationError) as caught:
        job_spec_adapter.validate_python(document)
    return {error.pointer: error.rule for error in field_errors(caught.value, document, AnyJobSpec)}


def lab(fx: float, cx: float) -> dict[str, Any]:
    return {
        "viewpoints": {
            "lab": LAB | {"camera_matrix": [[fx, 0.0, cx], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]]}
        }
    }


@pytest.mark.parametrize(
    ("change", "pointer", "rule"),
    [
        ({"textures": {"logo": "a" * 64}}, "/textures/logo", "sha256"),
        (
            {"textures": {"dots": f"sha256:{'a' * 64}"}},
            "",
            "textures must not redefine what is built in, and 'dots' is",
        ),
        ({"textures": {}}, "/axes/texture/1", "must be one of checker, .*, terrazzo"),
        (
            {"viewpoints": {"lab": LAB | {"distortion": [0.0] * 5 + [0.1]}}},
            "/viewpoints/lab",
            "must be 0 after k1",
        ),
        (
            {"viewpoints": {"lab": LAB | {"distortion": [-6.0]}}},
            "/viewpoints/lab",
            "in their order over the whole",
        ),
        (
            {"viewpoints": {"lab": LAB | {"distortion": [0.0, 0.0, 9.0]}}},
            "/viewpoints/lab",
            "in their order over",
        ),
        (
            {
                "viewpoints": {
                    "lab": LAB
                    | {"camera_matrix": [[700.0, 2.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]]}
                }
            },
            "/viewpoints/lab",
            "no skew",
        ),
        (lab(1e-6, 320.0), "/viewpoints/lab", "fx from 85.74 to 1.222e.04 px.* it is 1e-06 px"),
        (lab(1e12, 320.0), "/viewpoints/lab", "it is 1e.12 px"),
        (lab(700.0, 961.0), "/viewpoints/lab", "cx from -320 to 960 px"),
        (
            {"viewpoints": {"lab": LAB | {"tvec": [0.0, 9.0, 1.0]}}},
            "/viewpoints/lab",
            r"it is at \(0, -1, 9\) m",
        ),
        (
            {"viewpoints": {"lab": LAB | {"tvec": [0.0, -0.2, 1.0]}}},
            "/viewpoints/lab",
            "above the floor",
        ),
        (
            {"viewpoints": {"lab": LAB | {"image_size": [640.5, 480]}}},
            "/viewpoints/lab/image_size/0",
            "integer",
        ),
        (
            {"lamps": {"bench": LAMP | {"power": [1.0, 11.0]}}},
            "/lamps/bench/power/1",
            "less than or equal to 10",
        ),
        (
            {"lamps": {"bench": LAMP | {"power": [1.0, 0.9]}}},
            "/lamps/bench",
            r"power must be \[low, high\]",
        ),
        (
            {"substrates": {"baize": FLOOR | {"albedo": 0.2}}},
            "/substrates/baize/albedo",
            "must be a list",
        ),
        (
            {"substrates": {"baize": FLOOR | {"colour": 1}}},
            "/substrates/baize/colour",
            "there is no such field",
        ),
    ],
)
def test_what_cannot_be_rendered_is_refused(
    change: dict[str, Any], pointer: str, rule: str
) -> None:
    errors = _errors(_document(**change))
    assert list(errors) == [pointer]
    assert re.search(rule, errors[pointer]), errors


def test_a_calibration_of_the_clips_size_is_taken_as_it_is() -> None:
    numbers = LAB | {
        "image_size": [224, 224],
        "camera_matrix": [[300.0, 0.0, 110.0], [0.0, 301.0, 112.0], [0.0, 0.0, 1.0]],
    }
    camera = Calibration(**numbers).camera("lab")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (300.0, 301.0, 110.0, 112.0)
    np.testing.assert_allclose(camera.rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(camera.position, [0.0, -1.0, 0.2], atol=1e-12)


def test_a_large_image_is_cut_to_its_middle_and_made_smaller() -> None:
    """A point is where it is in the calibrated image, less the cut, over the scale.

    Edges of pixels go onto edges.
    """
    camera = Calibration(**LAB).camera("lab")
    point = np.array([[0.05, 0.1, 0.12]])
    pixels, _ = camera.project(point)
    x = point[0] @ np.asarray(camera.rotation).T + np.asarray(LAB["tvec"])
    u, v = 700.0 * x[0] / x[2] + 319.5, 700.0 * x[1] / x[2] + 239.5
    np.testing.assert_allclose(
        pixels[0], [(u - 80 + 0.5) * 224 / 480 - 0.5, (v + 0.5) * 224 / 480 - 0.5]
    )


def test_rotations_of_rodrigues_are_those_of_opencv() -> None:
    """Rotation vectors of the cameras of the rig, by another formula: the logarithm."""
    from scipy.spatial.transform import Rotation

    for camera in load_rig("drag"):
        rvec = Rotation.from_matrix(np.asarray(camera.rotation)).as_rotvec().tolist()
        decoded = Calibration(**LAB | {"rvec": rvec, "tvec": list(camera.translation)}).camera(
            "lab"
        )
        np.testing.assert_allclose(decoded.rotation, camera.rotation, atol=1e-9)


# --- pictures
# -------------------------------------------------------------------------------------------------

RANDOM = np.random.Generator(np.random.PCG64(3)).integers(0, 256, (80, 80, 3), dtype=np.uint8)


def _file(picture: Image.Image, form: str = "PNG", **more: Any) -> bytes:
    file = io.BytesIO()
    picture.save(file, format=form, **more)
    return file.getvalue()


def test_pictures_are_read_as_they_are() -> None:
    picture = Image.fromarray(RANDOM)
    assert np.array_equal(read_picture(_file(picture)), RANDOM)
    assert np.array_equal(read_picture(_file(picture.convert("RGBA"))), RANDOM)
    assert np.array_equal(
        read_picture(_file(picture.convert("L")))[..., 1], np.asarray(picture.convert("L"))
    )
    assert (
        np.abs(
            read_picture(_file(picture, "JPEG", quality=95, subsampling=0)).astype(int) - RANDOM
        ).mean()
        < 5
    )
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    turned = read_picture(
        _file(Image.fromarray(np.rot90(RANDOM, 2)), "JPEG", quality=100, subsampling=0, exif=exif)
    )
    assert np.abs(turned.astype(int) - RANDOM).mean() < 5


def _deep() -> bytes:
    """Return a PNG in colour with 16 bits a channel."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 80, 80, 16, 2, 0, 0, 0))]
    parts += [(b"IDAT", zlib.compress(bytes(80 * (1 + 80 * 6)))), (b"IEND", b"")]
    packed = [
        struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def _transparent() -> Image.Image:
    picture = Image.fromarray(RANDOM).convert("RGBA")
    picture.putpixel((3, 3), (1, 2, 3, 254))
    return picture


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        (b"", "whole PNG or JPEG"),
        (b"GIF89a" + bytes(100), "whole PNG or JPEG"),
        (_file(Image.fromarray(RANDOM), "GIF"), "whole PNG or JPEG"),
        (_file(Image.fromarray(RANDOM))[:-4000], "whole PNG or JPEG"),
        (
            _file(Image.fromarray(RANDOM[:70])),
            "square, of 64 to 4096 pixels a side, and it has 80 x 70",
        ),
        (_file(Image.fromarray(RANDOM[:60, :60])), "it has 60 x 60"),
        (_file(Image.new("1", (5000, 5000))), "it has 5000 x 5000"),
        (
            _file(Image.fromarray(np.zeros((80, 80), dtype=np.uint16))),
            "8 bits a channel, and its mode is I;16",
        ),
        (_deep(), "at most 8 bits a channel, and it has 16"),
        (_file(Image.fromarray(RANDOM).convert("CMYK"), "JPEG"), "its mode is CMYK"),
        (_file(_transparent()), "opaque"),
        (bytes(MAX_BYTES + 1), "at most"),
    ],
)
def test_files_that_are_no_textures_are_refused(data: bytes, rule: str) -> None:
    with pytest.raises(UnfitPictureError, match=rule):
        read_picture(data)


@pytest.mark.physics
def test_a_small_file_of_a_huge_picture_is_not_decoded() -> None:
    """A PNG of 30,000 x 30,000 black pixels has some kilobytes: it is refused for its header."""
    bomb = _file(Image.new("1", (30_000, 30_000)), optimize=False)
    assert len(bomb) < 200_000
    with pytest.raises(UnfitPictureError, match=r"30000 x 30000|exceeds limit"):
        read_picture(bomb)
