"""What is composed is what the formula says, and what Cycles renders directly."""

from typing import Any

import numpy as np
import pytest
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.quality import (
    FEWEST,
    UNMEASURED,
    Measured,
    errors,
    instants,
    measured_group,
    pool_errors,
)
from stickslip_blender.cloth.textures import texture_image
from stickslip_blender.cycles.engine import CLOTH_SAMPLING, ClothSampling
from stickslip_blender.cycles.pixels import encode
from stickslip_blender.raster import decoded
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.cameras import load_rig, rig_digest
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.spec.names import Texture


def test_encoding_is_srgb() -> None:
    light = np.array([-0.1, 0.0, 0.001, 0.0031308, 0.2, 0.5, 1.0, 3.0], dtype=np.float32)
    assert encode(light).tolist() == [0, 0, 3, 10, 124, 188, 255, 255]


def test_the_noise_of_references_is_not_an_error_of_the_clip() -> None:
    """Errors of 3 levels at five brightnesses, whatever the noise.

    Highlights have no level above 255.
    """
    random = np.random.Generator(np.random.PCG64(1))
    truth = np.repeat(np.array([20, 60, 120, 180, 230], dtype=np.uint8), 40_000).reshape(400, 500)
    clip = (truth + 3 * random.choice([-1, 1], truth.shape)).astype(np.uint8)
    for noise in (0.1, 0.4):
        light = decoded(truth) * (1.0 + noise * random.standard_normal((4, *truth.shape)))
        light[2:, :200] = np.nan
        pooled = pool_errors(
            [
                (
                    errors(np.dstack([clip] * 3), light[..., None], 0),
                    np.ones((3, 400, 500), dtype=bool),
                )
            ]
        )
        exact = 10.0 * np.log10(255.0**2 / 9.0)
        assert abs(pooled.psnr[0] - exact) < max(0.15, 2.5 * pooled.deviations[0])
    white, bright = np.full((8, 8, 3), 255, dtype=np.uint8), np.full((2, 8, 8, 3), 1.7)
    assert errors(white, bright, 0).max() < 1e-4


def test_frames_in_the_shade_count_though_they_are_not_measured() -> None:
    """One frame of three is measured, and errors of the others are expected to be four times as
    large.
    """
    measured = np.ones((3, 64, 64))
    pooled = pool_errors([(np.full((64, 64), 4.0), measured)], mean_weights=(1.0, 3.0, 1.0))
    exact = [10.0 * np.log10(255.0**2 / (4.0 * usual)) for usual in (1.0, 3.0, 1.0)]
    assert pooled.psnr == pytest.approx(exact)
    assert min(pooled.deviations) > 1.0  # of one frame


def test_a_region_of_too_few_pixels_has_no_number() -> None:
    weights = np.ones((3, 8, 8))
    weights[1] = 0.0
    weights[1].flat[: FEWEST - 1] = 1.0
    weights[2] = 0.0
    weights[2].flat[:FEWEST] = 1.0
    measured = pool_errors([(np.full((8, 8), 4.0), weights)])
    assert np.isnan([measured.psnr[1], measured.deviations[1]]).all()
    assert measured.labels["psnr_landed"] is None
    assert measured.psnr[2] == pytest.approx(10.0 * np.log10(255.0**2 / 4.0))


def test_deviations_grow_with_the_spread_of_frames_and_of_blocks() -> None:
    """Hand-computed: two frames of 16 x 16 pixels in blocks of 8, weight 1 everywhere."""
    weights = np.ones((3, 16, 16))
    even = [(np.full((16, 16), 4.0), weights)] * 2
    frames = [(np.full((16, 16), 2.0), weights), (np.full((16, 16), 6.0), weights)]
    prior = 4 * 0.6**2  # four frames of a spread of 0.6

    # Equal blocks and frames: the deviation is that of frames before any is measured.
    expected = 10.0 / np.log(10.0) * np.sqrt(prior / 5 / 2)
    assert pool_errors(even).deviations == pytest.approx([expected] * 3)

    # Eight blocks of 64 pixels differ by 128 from the mean 4: sqrt(8 * 128^2) / 512 over 4. Each
    # frame differs by half of the mean.
    within = np.sqrt(8 * 128.0**2) / 512 / 4.0
    between = (2 * 0.5**2 + prior) / 5 / 2
    expected = 10.0 / np.log(10.0) * np.sqrt(within**2 + between)
    assert pool_errors(frames).deviations == pytest.approx([expected] * 3)
    assert pool_errors(frames).psnr == pytest.approx(pool_errors(even).psnr)

    # Frames that were not measured have another error: one of three, and none of two.
    of_three, of_two = pool_errors(frames, frame_count=3), pool_errors(frames, frame_count=2)
    expected = 10.0 / np.log(10.0) * np.sqrt(within**2 + between / 3)
    assert of_three.deviations == pytest.approx([expected] * 3)
    assert of_two.deviations == pytest.approx([10.0 / np.log(10.0) * within] * 3)


def test_a_mean_below_zero_counts_as_its_deviation() -> None:
    """Products of noise may be negative: the error is then as large as chance makes it."""
    weights = np.ones((3, 16, 16))
    error = np.full((16, 16), -1.0)
    error[:8] = 0.5
    measured = pool_errors([(error, weights)])
    within = np.sqrt(4 * (64 * 0.75) ** 2) / 256
    assert measured.psnr[0] == pytest.approx(10.0 * np.log10(255.0**2 / within))


def test_small_cloth_has_more_paths() -> None:
    sampling = ClothSampling(1, 5, (0.0, 0.0, 0.0))
    assert [
        sampling.over(area).window for area in (20_000.0, 13_000.0, 10_000.0, 8_000.0, 1.0)
    ] == [5, 5, 6, 8, 8]


def test_a_clip_below_its_floor_says_so() -> None:
    measured = Measured((33.0, 30.0, 27.0), (0.1, 2.0, 0.1))
    assert (
        measured.shortfall((32.0, 33.0, 28.0))
        == "psnr_edge must be at least 28 dB; got 27.0 dB (deviation 0.1 dB)"
    )
    assert UNMEASURED.shortfall((99.0, 99.0, 99.0)) == ""
    assert Measured((30.0,) * 3, (1.0,) * 3).shortfall((32.0,) * 3) == ""  # within two deviations
    assert UNMEASURED.labels["psnr_landed"] is None


def test_measured_frames_are_drawn_from_equal_parts_of_the_clip() -> None:
    for seed in range(20):
        drawn = instants(30, 0.25, 6, 2, (seed, 3))
        for part, frame in enumerate(drawn):
            assert int(30 * part / len(drawn)) <= frame < 30 * (part + 1) / len(drawn)
        assert len(drawn) >= 3
    assert instants(5, 9.0, 16, 2, (1, 3)) == [0, 1, 2, 3, 4]
    # One frame of a short clip says little about the others.
    assert instants(3, 0.1, 4, 2, (1, 3)) == [0, 1, 2]
    assert len(instants(12, 0.1, 4, 2, (1, 3))) == 4
    assert measured_group("checker") == ("checker", "dots", "stripes")
    names = [str(texture) for texture in Texture]
    for number, name in enumerate(names):
        group = measured_group(name)
        assert group == tuple(names[number - number % 3 : number - number % 3 + 3])
        assert group.index(name) < 3
    assert measured_group("sha256:0") == ("sha256:0",)


@pytest.mark.parametrize(
    ("material", "substrate"),
    [
        ("gray-interlock", "matt"),
        ("gray-interlock", "polyester-mirror"),
        ("white-swim-solid", "stainless-steel"),
    ],
)
def test_a_composed_picture_is_the_direct_one(sheet: Any, material: str, substrate: str) -> None:
    look = ClothDragRender(
        rig="drag",
        rig_digest=rig_digest("drag"),
        quality="draft",
        material=material,
        texture="plaid",
        viewpoint="calibrated",
        instants=(1,),
        light_seed=3,
        crease_seed=5,
        creases=0.5,
        substrate=substrate,
    )
    renderer = ClothRenderer(sheet.triangles, sheet.rest, Holders)
    clip = renderer.clip(
        look, load_rig("drag")[0], sheet.track[1:2], sampling=ClothSampling(4, 4, (0.0, 0.0, 0.0))
    )
    names = measured_group("plaid")
    pictures = [texture_image(Texture(name)) for name in names]
    shading = clip.shading()
    videos, _ = clip.clips(shading, pictures)
    weights, usual = clip.weights(shading)
    ((_, light),) = clip.references(pictures, [0])
    for channel, video in enumerate(videos):
        pooled = pool_errors([(errors(video[0], light, channel), weights[0])], usual)
        assert min(pooled.psnr) > 28.0, names[channel]
        assert pooled.psnr[0] > 35.0, names[channel]


@pytest.mark.parametrize(
    ("area", "paths"), [(0.0, 8), (5_000.0, 8), (10_833.0, 6), (13_000.0, 5), (50_000.0, 5)]
)
def test_small_windows_get_more_paths_and_cloth_out_of_the_frame_too(
    area: float, paths: int
) -> None:
    assert CLOTH_SAMPLING[Quality.standard].over(area).window == paths
