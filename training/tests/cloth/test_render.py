from dataclasses import replace

import numpy as np
import pytest
import torch
from stickslip_testing.cameras import looking_at
from stickslip_training.cloth.clips import INSTANTS, LATE_MAX, RATE, frames_at, training_cameras
from stickslip_training.cloth.crop import (
    ANCHOR,
    HEIGHT,
    WIDTH,
    Cameras,
    Crops,
    cut,
    grey,
    holder_crops,
    holder_path,
)
from stickslip_training.cloth.render import refine, render_crops, rotate_cameras, splat
from stickslip_training.cloth.style import TEXTURE_SIZE, sample_style, sample_textures
from stickslip_training.cloth.surroundings import Codec, apply_codec, sample_surroundings

RIG = training_cameras()
FACING = looking_at(
    (0.0, 0.0, 0.0),
    azimuth=0,
    elevation=0,
    distance=1.0,
    name="facing",
    width=64,
    height=48,
    focal=100.0,
)


def square(side, center=(0.0, 0.0), half=0.1, x=0.0):
    """A square in the plane of x, as a grid of vertices; 100 px a metre in `FACING`."""
    y, z = torch.meshgrid(
        torch.linspace(-half, half, side), torch.linspace(-half, half, side), indexing="xy"
    )
    return torch.stack([torch.full_like(y, x), y + center[0], z + center[1]], dim=-1)


def silhouettes(positions, camera, points):
    """Fraction of each pixel that meshes (F, side, side, 3) cover, (F, height, width)."""
    fine = refine(positions[None], points)
    whole = Crops(
        torch.tensor(ANCHOR[::-1]).expand(1, len(positions), 2), torch.ones(1, len(positions))
    )
    size = camera.height, camera.width
    return splat(fine, torch.ones(fine.shape[:-1]), Cameras.of([camera]), whole, size=size)[0][0]


def test_a_square_covers_its_area_wherever_it_lies():
    for center in ((0.0, 0.0), (0.0037, -0.0061), (0.05, 0.02)):
        covered = silhouettes(square(5, center)[None], FACING, points=60)[0]
        assert covered.sum().item() == pytest.approx(20 * 20, rel=2e-3)
        assert covered[24, 31 + round(100 * center[0])].item() == pytest.approx(1.0, abs=0.02)


def test_an_edge_moves_through_a_pixel_as_far_as_the_cloth_does():
    sums = [
        silhouettes(square(5, (shift / 100, 0.0))[None], FACING, points=60)[0].sum(dim=0)
        for shift in (0.0, 0.3)
    ]
    column = torch.arange(64.0)
    centers = [float((total * column).sum() / total.sum()) for total in sums]
    assert centers[1] - centers[0] == pytest.approx(0.3, abs=0.01)


def test_what_is_nearer_hides_what_is_behind():
    """Cloth that goes up on one side and comes down on the other, dark and bright."""
    up = torch.linspace(-0.05, 0.05, 15)
    z = torch.cat([up, up.flip(0)])[:, None].expand(30, 30)
    x = torch.cat([torch.full((15,), -0.05), torch.full((15,), 0.05)])[:, None].expand(30, 30)
    points = torch.stack([x, torch.linspace(-0.05, 0.05, 30).expand(30, 30), z], dim=-1)[None, None]
    colors = (x > 0).float()[None, None]
    for azimuth, expected in ((0, 1.0), (180, 0.0)):
        camera = looking_at(
            (0, 0, 0),
            azimuth=azimuth,
            elevation=0,
            distance=1.0,
            name="c",
            width=64,
            height=48,
            focal=100.0,
        )
        whole = Crops(torch.tensor(ANCHOR[::-1]).expand(1, 1, 2), torch.ones(1, 1))
        alpha, color = splat(points, colors, Cameras.of([camera]), whole, size=(48, 64))
        opaque_colors = color[alpha > 0.9]
        assert len(opaque_colors) > 60
        assert (opaque_colors == expected).float().mean() > 0.99


def test_the_holders_move_as_in_the_simulations(runs):
    x, z = holder_path(runs.instants)
    held = runs.positions[:, :, -1, [0, -1]].mean(axis=2)
    expected = torch.stack([x, torch.zeros_like(x), z], dim=-1).numpy()
    assert np.abs(held - expected).max() < 3e-5


@pytest.mark.parametrize("camera", RIG, ids=lambda camera: camera.name)
def test_crops_of_a_picture_are_what_is_rendered_into_them(runs, camera):
    frames, instants = frames_at(runs.instants)
    meshes = torch.from_numpy(runs.positions[:1, frames])
    cameras = Cameras.of([camera])
    crops = holder_crops(cameras, instants)
    fine = refine(meshes, TEXTURE_SIZE)
    direct = splat(fine, torch.ones(fine.shape[:-1]), cameras, crops)[0]
    through = cut(silhouettes(meshes[0], camera, points=200)[None], crops)
    assert through.shape == direct.shape == (1, 6, HEIGHT, WIDTH)
    assert (through - direct).abs().mean() < 0.012
    solid = direct > 0.5, through > 0.5
    assert (solid[0] & solid[1]).sum() / (solid[0] | solid[1]).sum() > 0.97


def test_turning_a_camera_turns_it_about_the_scene():
    cameras = Cameras.of(RIG)
    still = rotate_cameras(cameras, torch.zeros(3), torch.zeros(3))
    torch.testing.assert_close(still.rotation, cameras.rotation)
    moved = rotate_cameras(cameras, torch.full((3,), 0.2), torch.full((3,), -0.1))
    middle = torch.tensor([0.15, 0.0, 0.05]).expand(3, 1, 3)
    for before, after in zip(cameras.project(middle), moved.project(middle), strict=True):
        torch.testing.assert_close(after, before, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(
        moved.rotation @ moved.rotation.transpose(1, 2), torch.eye(3).expand(3, 3, 3)
    )
    place = -(moved.rotation.transpose(1, 2) @ moved.translation[..., None])[..., 0] - middle[:, 0]
    old = (
        -(cameras.rotation.transpose(1, 2) @ cameras.translation[..., None])[..., 0] - middle[:, 0]
    )
    angles = [torch.atan2(each[:, 1], each[:, 0]) for each in (place, old)]
    assert (angles[0] - angles[1]).abs().tolist() == pytest.approx([0.2] * 3, abs=0.02)


def test_looks_are_drawn_from_the_seed_and_are_many():
    textures = sample_textures(40, torch.Generator().manual_seed(1))
    assert textures.min() >= 0.1
    assert textures.max() <= 0.9
    assert len({tuple(texture.flatten().tolist()) for texture in textures}) == 40
    assert torch.equal(textures, sample_textures(40, torch.Generator().manual_seed(1)))


def test_frames_are_found_by_their_instants():
    frames, instants = frames_at(tuple(range(0, 300, 10)))
    assert instants == INSTANTS
    assert frames == [6, 8, 13, 15, 21, 22]
    with pytest.raises(
        ValueError, match=r"must have a frame within 0\.06 s of 25\.00 s .* of 2 is at 0\.00 s"
    ):
        frames_at((0, 150))


@pytest.mark.parametrize("count", [24, 30, 75, 150, 300, 375, 400])
@pytest.mark.parametrize("cut", [0.0, 0.5])
def test_any_clip_is_read_at_the_right_times_or_refused(count, cut):
    times = cut + np.arange(count) * (125.0 - 2 * cut) / count
    late = max(np.abs(times - instant / RATE).min() for instant in INSTANTS)
    if late > LATE_MAX:
        with pytest.raises(ValueError, match="must have a frame within"):
            frames_at(times * RATE)
    else:
        assert np.abs(np.subtract(frames_at(times * RATE)[1], INSTANTS)).max() <= LATE_MAX * RATE


def test_grey_levels():
    video = torch.tensor([[[[255, 255, 255], [0, 0, 0], [255, 0, 0]]]], dtype=torch.uint8)
    assert grey(video).flatten().tolist() == pytest.approx([1.0, 0.0, 0.299], abs=1e-6)


def test_a_world_is_drawn_from_the_seed_about_the_same_cloth(runs):
    frames, instants = frames_at(runs.instants)
    meshes = torch.from_numpy(runs.positions[:3, frames])
    cameras = Cameras.of(RIG)

    def world_of(seed, drawn=True):
        generator = torch.Generator().manual_seed(seed)
        style, world = (
            sample_style(3, 6, generator),
            sample_surroundings(3, generator) if drawn else None,
        )
        return render_crops(meshes, cameras, instants, style, generator, world)

    first, again, other, dark = world_of(1), world_of(1), world_of(2), world_of(1, drawn=False)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])
    behind = (first[1] == 0) & (dark[1] == 0)
    assert first[0][behind].mean() > dark[0][behind].mean() + 0.1
    assert 0 <= first[0].min() <= first[0].max() <= 1
    assert (
        first[1] - dark[1]
    ).abs().mean() < 0.05  # the camera is off by 3 % and 1.5 degrees at most


def test_a_codec_keeps_what_is_smooth():
    number = torch.ones(2, 1, 1, 1)
    codec = Codec(is_on=torch.tensor([1.0, 0.0])[:, None, None, None], step=0.1 * number)
    ramp = torch.linspace(0, 1, WIDTH).expand(2, 1, HEIGHT, WIDTH) + 0.02 * torch.randn(
        2, 1, HEIGHT, WIDTH
    )
    decoded = apply_codec(ramp, codec)
    assert torch.equal(decoded[1], ramp[1])
    assert 0.001 < (decoded[0] - ramp[0]).abs().mean() < 0.03
    assert torch.allclose(apply_codec(ramp, replace(codec, step=1e-4 * number)), ramp, atol=1e-3)
