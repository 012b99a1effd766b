"""Clips of cloth: the same bytes always, the cloth where the cameras project it, the light as
drawn.
"""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.textures import texture_image
from stickslip_blender.raster import projected, see, window_about
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.cameras import Camera, load_rig, rig_digest
from stickslip_schemas.spec.names import Texture

LOOK = {
    "rig": "drag",
    "rig_digest": rig_digest("drag"),
    "quality": "preview",
    "material": "gray-interlock",
    "texture": "gingham",
    "viewpoint": "calibrated",
    "instants": (0, 3),
    "light_seed": 3,
    "crease_seed": 5,
}
Clip = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def renderer(make_sheet: Callable[..., Any]) -> ClothRenderer:
    """One scene for all tests that need no other; the last test of this module builds others."""
    sheet = make_sheet()
    return ClothRenderer(sheet.triangles, sheet.rest, Holders)


def _render(renderer: ClothRenderer, sheet: Any, *textures: Texture, **look: Any) -> Clip:
    document = ClothDragRender.model_validate(LOOK | look)
    (camera,) = (camera for camera in load_rig("drag") if camera.name == document.viewpoint)
    clip = renderer.clip(document, camera, sheet.track[list(document.instants)])
    return clip.clips(
        clip.shading(), [texture_image(texture) for texture in textures or (Texture.gingham,)]
    )[0]


def test_a_repeat_has_the_same_bytes(renderer: ClothRenderer, sheet: Any) -> None:
    first = _render(renderer, sheet)
    assert (first.shape, first.dtype) == ((1, 2, 224, 224, 3), np.uint8)
    _render(
        renderer,
        sheet,
        viewpoint="right",
        material="11oz-black-denim",
        substrate="ceramic",
        creases=0.7,
    )
    both = _render(renderer, sheet, Texture.dots, Texture.gingham)
    assert np.array_equal(both[1], first[0])


_FRESH = """
import hashlib, sys
import numpy as np
from stickslip_blender.cycles.engine import import_bpy
from stickslip_blender.cloth.clips import ClothRenderer
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cloth.textures import texture_image
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.names import Texture
sheet = np.load(sys.argv[1])
look = ClothDragRender.model_validate_json(sys.argv[2])
renderer = ClothRenderer(sheet["triangles"], sheet["rest"], Holders)
import_bpy().context.scene.render.threads = 2
clip = renderer.clip(look, load_rig("drag")[0], sheet["track"][[0, 3]])
video, _ = clip.clips(clip.shading(), [texture_image(Texture.gingham)])
print(hashlib.sha256(video.tobytes()).hexdigest())
"""


def test_a_fresh_process_with_two_threads_makes_the_same_bytes(
    renderer: ClothRenderer, sheet: Any, tmp_path: Path
) -> None:
    """Also where this process has rendered other clips before."""
    np.savez(tmp_path / "sheet.npz", triangles=sheet.triangles, rest=sheet.rest, track=sheet.track)
    look = ClothDragRender.model_validate(LOOK).model_dump_json()
    done = subprocess.run(
        [sys.executable, "-c", _FRESH, str(tmp_path / "sheet.npz"), look],
        capture_output=True,
        text=True,
        check=True,
    )
    _render(renderer, sheet, Texture.dots, viewpoint="right", substrate="ceramic", instants=(0,))
    video = _render(renderer, sheet)
    assert done.stdout.split()[-1] == hashlib.sha256(video.tobytes()).hexdigest()


def test_what_stands_still_has_the_same_bytes_in_every_frame(
    renderer: ClothRenderer, sheet: Any
) -> None:
    look, picture = ClothDragRender.model_validate(LOOK), texture_image(Texture.floral)
    clip = renderer.clip(look, load_rig("drag")[0], np.repeat(sheet.track[:1], 2, axis=0))
    (video,), _ = clip.clips(clip.shading(), [picture])
    assert np.array_equal(video[0], video[1])


def test_the_stage_is_dark_and_the_cloth_is_not(renderer: ClothRenderer, sheet: Any) -> None:
    (clip,) = _render(renderer, sheet, instants=(0,))
    assert clip[:, :30].mean() < 45
    assert np.median(clip) < 70
    assert np.quantile(clip.max(axis=3), 0.99) > 95
    assert (clip.min(axis=3) >= 254).mean() < 0.01


def test_the_cloth_is_lit_alike_everywhere_and_the_floor_at_all_times(
    renderer: ClothRenderer, sheet: Any
) -> None:
    """The first and the last instant show the same cloth 30 cm apart: it is as bright there as
    here.
    """
    (clip,) = _render(renderer, sheet, Texture.floral)
    camera = load_rig("drag")[0]
    brightness, away = [], np.ones((224, 224), dtype=bool)
    for frame, instant in zip(clip, (0, 3), strict=True):
        points = renderer.geometry.points(sheet.track[instant], instant)
        window = window_about(projected(camera, points[: renderer.geometry.cloth_vertices]), camera)
        visibility = see(projected(camera, points), renderer.geometry.triangles, window)
        cloth = visibility.share_below(renderer.geometry.cloth_triangles) == 1.0
        brightness.append(frame[window.slices][cloth].mean())
        away[window_about(projected(camera, points), camera, 20).slices] = False
    assert brightness[1] == pytest.approx(brightness[0], rel=0.08)
    assert away.sum() > 5000
    assert np.abs(clip[1, away].astype(int) - clip[0, away]).mean() < 1.5


def test_noise_is_still_in_a_clip_and_differs_between_clips(
    renderer: ClothRenderer, sheet: Any
) -> None:
    still = ClothDragRender.model_validate(LOOK)
    clip = renderer.clip(still, load_rig("drag")[0], np.repeat(sheet.track[:1], 2, axis=0))
    (first, second), again = clip.shading(), clip.shading()
    assert np.array_equal(first, second)
    assert np.array_equal(again[0], first)
    object.__setattr__(clip, "seed", still.light_seed + 1)
    assert not np.array_equal(clip.shading()[0], first)


def test_what_is_not_the_cloth_is_refused(renderer: ClothRenderer, sheet: Any) -> None:
    look, camera = ClothDragRender.model_validate(LOOK), load_rig("drag")[0]
    with pytest.raises(ValueError, match=r"of shape \(frames, 81, 3\); got shape \(4, 80, 3\)"):
        renderer.clip(look, camera, sheet.track[:, 1:])
    with pytest.raises(ValueError, match="positions must be finite"):
        renderer.clip(look, camera, sheet.track * np.nan)


@pytest.mark.parametrize(
    "view", [0, *(pytest.param(view, marks=pytest.mark.slow) for view in (1, 2))]
)
def test_the_silhouette_is_that_of_cycles(make_sheet: Callable[..., Any], view: int) -> None:
    """The cloth shines by itself before black in Cycles: what a pixel then has of its light is its
    coverage.
    """
    from stickslip_blender.cycles.engine import Sampling

    sheet = make_sheet(17)
    renderer = ClothRenderer(sheet.triangles, sheet.rest, Holders)
    stage, geometry = renderer.scene, renderer.geometry
    camera: Camera = load_rig("drag")[view]
    renderer.clip(ClothDragRender.model_validate(LOOK), camera, sheet.track[[2, 2]])
    points = geometry.points(sheet.track[2], 2)
    light = _glowing(stage, points, Sampling(samples=256))
    window = window_about(projected(camera, points[: geometry.cloth_vertices]), camera, 2)
    coverage = see(projected(camera, points), geometry.triangles, window).share_below(
        geometry.cloth_triangles
    )
    error = np.abs(light[window.slices][..., 0] - coverage)
    edge = (coverage > 0.0) & (coverage < 1.0)
    assert edge.sum() > 200
    assert error[edge].mean() < 0.025  # 256 random samples: 0.02 by chance
    assert error.mean() < 0.002
    assert (light[window.slices][..., 0] - coverage).mean() == pytest.approx(0.0, abs=5e-4)


def _glowing(stage: Any, points: Any, sampling: Any) -> npt.NDArray[np.float32]:
    from stickslip_blender.cycles.engine import import_bpy

    data = import_bpy().data
    tree = data.materials["fabric"].node_tree
    glow = tree.nodes.new("ShaderNodeEmission")
    glow.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    tree.links.new(glow.outputs["Emission"], tree.nodes["Material Output"].inputs["Surface"])
    data.objects["lamp"].hide_render = True
    data.objects["floor"].hide_render = True
    for prop in ("holder-1", "holder-2"):
        black = data.materials[prop].node_tree.nodes["Principled BSDF"]
        black.inputs["Base Color"].default_value = (0.0, 0.0, 0.0, 1.0)
        black.inputs["Specular IOR Level"].default_value = 0.0
    return np.asarray(
        stage.direct(points, np.full((8, 8, 3), 255, np.uint8), sampling), dtype=np.float32
    )
