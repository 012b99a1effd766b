"""Clips of cloth: the same bytes always, the cloth where the cameras project it, the light as drawn."""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageDraw
from stickslip_blender.cloth import ClothRenderer, Light
from stickslip_blender.engine import Sampling
from stickslip_schemas.cameras import Camera, load_rig
from stickslip_schemas.textures import Texture

QUICK = Sampling(samples=2, denoiser="fast")
LAMP = Light(azimuth=-30.0, elevation=50.0, power=1.0, floor=0.025, roughness=0.35)
Clip = npt.NDArray[np.uint8]


@pytest.fixture
def cameras() -> tuple[Camera, ...]:
    return load_rig("drag-3")


@pytest.fixture
def clip(sheet: Any, cameras: tuple[Camera, ...]) -> Clip:
    with ClothRenderer(sheet.triangles, sheet.rest, quality=QUICK) as renderer:
        return renderer.render(sheet.track[::3], cameras[0], texture=Texture.gingham, light=LAMP)


def test_a_repeat_has_the_same_bytes(sheet: Any, cameras: tuple[Camera, ...], clip: Clip) -> None:
    assert clip.shape == (2, 224, 224, 3)
    assert clip.dtype == np.uint8
    with ClothRenderer(sheet.triangles, sheet.rest, quality=QUICK) as renderer:
        renderer.render(sheet.track[1:2], cameras[2], texture=Texture.dots, light=Light.drawn(3))  # leaves no trace
        again = renderer.render(sheet.track[::3], cameras[0], texture=Texture.gingham, light=LAMP)
        alone = renderer.render(sheet.track[3:], cameras[0], texture=Texture.gingham, light=LAMP)
    assert np.array_equal(again, clip)
    assert np.array_equal(alone[0], clip[1])  # a frame does not depend on those before it


_FRESH = """
import hashlib, sys
import numpy as np
from stickslip_blender.cloth import ClothRenderer, Light
from stickslip_blender.engine import Sampling
from stickslip_schemas.cameras import load_rig
from stickslip_schemas.textures import Texture
sheet = np.load(sys.argv[1])
light = Light(azimuth=-30.0, elevation=50.0, power=1.0, floor=0.025, roughness=0.35)
with ClothRenderer(sheet["triangles"], sheet["rest"], quality=Sampling(samples=2, denoiser="fast")) as renderer:
    clip = renderer.render(sheet["track"][::3], load_rig("drag-3")[0], texture=Texture.gingham, light=light)
print(hashlib.sha256(clip.tobytes()).hexdigest())
"""


def test_a_fresh_process_makes_the_same_bytes(sheet: Any, clip: Clip, tmp_path: Path) -> None:
    np.savez(tmp_path / "sheet.npz", triangles=sheet.triangles, rest=sheet.rest, track=sheet.track)
    done = subprocess.run(
        [sys.executable, "-c", _FRESH, str(tmp_path / "sheet.npz")], capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[-1:] == [hashlib.sha256(clip.tobytes()).hexdigest()]


@pytest.mark.parametrize("view", [0, 1, 2])
def test_the_cloth_is_where_the_camera_projects_it(
    make_sheet: Callable[..., Any], cameras: tuple[Camera, ...], view: int
) -> None:
    """Pixels that have a hue, of brown herringbone, are those of its projected triangles: nothing else has one."""
    sheet = make_sheet(17)
    lamp = Light(azimuth=-20.0, elevation=60.0, power=1.2, floor=0.02, roughness=0.45)
    with ClothRenderer(sheet.triangles, sheet.rest, quality=Sampling(samples=16)) as renderer:
        (frame,) = renderer.render(sheet.track[2:3], cameras[view], texture=Texture.herringbone, light=lamp)
    pixels, _ = cameras[view].project(sheet.track[2])
    image = Image.new("1", (224, 224))
    for triangle in sheet.triangles:
        ImageDraw.Draw(image).polygon([tuple(corner) for corner in pixels[triangle]], fill=1)
    outline = np.asarray(image)
    colored = frame.max(axis=2).astype(int) - frame.min(axis=2) > 8
    assert (colored & outline).sum() / outline.sum() > 0.85  # the rest is in shadow
    assert (colored & ~outline).sum() < 0.12 * outline.sum()  # the edge, and the mirror image in the floor


def test_the_stage_is_dark_and_the_cloth_is_not(clip: Clip) -> None:
    assert clip[:, :30].mean() < 45
    assert np.median(clip) < 70
    assert np.quantile(clip.max(axis=3), 0.99) > 150
    assert (clip.min(axis=3) >= 254).mean() < 0.01


def test_texture_and_light_matter(sheet: Any, cameras: tuple[Camera, ...], clip: Clip) -> None:
    with ClothRenderer(sheet.triangles, sheet.rest, quality=QUICK) as renderer:

        def first(texture: Texture, light: Light) -> Clip:
            return renderer.render(sheet.track[:1], cameras[0], texture=texture, light=light)

        looks = [first(texture, LAMP) for texture in Texture]
        looks += [first(Texture.gingham, Light.drawn(seed)) for seed in (1, 2)]
        bright = first(Texture.gingham, Light(LAMP.azimuth, LAMP.elevation, 1.25, LAMP.floor, LAMP.roughness))
    assert len({look.tobytes() for look in looks}) == len(looks)
    assert np.array_equal(looks[list(Texture).index(Texture.gingham)][0], clip[0])
    assert bright.mean() > 1.04 * clip[0].mean()


def test_lights_keep_within_their_bounds_and_fill_them() -> None:
    lights = [Light.drawn(seed) for seed in range(300)]
    bounds = {
        "azimuth": (-75.0, 15.0),
        "elevation": (42.0, 62.0),
        "power": (0.8, 1.25),
        "floor": (0.012, 0.04),
        "roughness": (0.25, 0.45),
    }
    for name, (low, high) in bounds.items():
        values = np.array([getattr(light, name) for light in lights])
        assert low <= values.min() < low + 0.05 * (high - low), name
        assert high - 0.05 * (high - low) < values.max() <= high, name
    assert Light.drawn(5) == lights[5]


def test_what_is_still_does_not_flicker(sheet: Any, cameras: tuple[Camera, ...]) -> None:
    """The same cloth twice is the same frame twice, and a far corner of the floor is the same while the cloth moves."""
    still = np.repeat(sheet.track[:1], 2, axis=0)
    with ClothRenderer(sheet.triangles, sheet.rest, quality=Sampling(samples=4)) as renderer:
        first, second = renderer.render(still, cameras[0], texture=Texture.plaid, light=LAMP)
        moved = renderer.render(sheet.track[3:], cameras[0], texture=Texture.plaid, light=LAMP)[0]
    assert np.array_equal(first, second)
    corner = np.s_[200:, :24]
    assert np.abs(first[corner].astype(int) - moved[corner]).mean() < 2.0


def test_what_is_not_the_cloth_is_refused(sheet: Any, cameras: tuple[Camera, ...]) -> None:
    with ClothRenderer(sheet.triangles, sheet.rest, quality=QUICK) as renderer:
        with pytest.raises(ValueError, match=r"of shape \(frames, 81, 3\); got shape \(4, 80, 3\)"):
            renderer.render(sheet.track[:, 1:], cameras[0], texture=Texture.dots, light=LAMP)
        with pytest.raises(ValueError, match="positions must be finite"):
            renderer.render(sheet.track * np.nan, cameras[0], texture=Texture.dots, light=LAMP)
