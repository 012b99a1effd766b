"""How well our rasteriser and cameras agree with Cycles': coverage of the cloth's pixels, and its corners' places.

Runs in Blender's interpreter, on a trajectory that `benchmarks/render_trajectory.py` has written:

    .venv/bin/python benchmarks/render_trajectory.py /tmp/cloth.npz
    .venv-blender/bin/python benchmarks/render_silhouettes.py /tmp/cloth.npz [--frames 3]

Coverage: in Cycles, the cloth shines by itself before black, with 256 samples a pixel, and the light of a pixel is what
the cloth covers of it. The error is the mean over the window that the cloth is in.

Corners: the four of the cloth at all instants, projected by `Camera.project` and by Blender, with all cameras of the
rig.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_blender.blender import import_bpy
from stickslip_blender.clips import ClothRenderer
from stickslip_blender.engine import REFERENCE
from stickslip_blender.holders import Holders
from stickslip_blender.lights import drawn_light
from stickslip_blender.looks import look_of
from stickslip_blender.raster import projected, see, window_about
from stickslip_blender.substrates import drawn_substrate
from stickslip_blender.view import set_view
from stickslip_schemas.spec.cameras import load_rig

VIEWS = ("calibrated", "left", "right")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("trajectory", type=Path)
    arguments.add_argument("--frames", type=int, default=3, help="instants, each in three views")
    options = arguments.parse_args()
    with np.load(options.trajectory) as file:
        track, rest = file["track"].astype(np.float64), file["rest"]
        renderer = ClothRenderer(file["triangles"], rest, Holders)
    coverage(renderer, track, options.frames)
    corners(renderer, track, rest)


def coverage(renderer: ClothRenderer, track: npt.NDArray[np.float64], count: int) -> None:
    """Print the error of the coverage by view."""
    stage, geometry = renderer.stage, renderer.geometry
    look = look_of("gray-interlock")
    geometry.surface.dress(hem=1e-3 * look.hem, creases=0.5, seed=1)
    _let_shine()
    for camera in load_rig("drag"):
        if camera.name not in VIEWS:
            continue
        stage.set_up(camera, drawn_light("drawn", 1), drawn_substrate("matt", 1), look)
        errors = []
        for frame in np.linspace(8, len(track) - 1, count).astype(int).tolist():
            shot = stage.shot(track[frame], frame)
            window = window_about(projected(camera, shot.points[: geometry.cloth_vertices]), camera, 2)
            seen = see(projected(camera, shot.points), geometry.triangles, window)
            share = seen.share_below(geometry.cloth_triangles)
            white = np.full((8, 8, 3), 255, dtype=np.uint8)
            difference = stage.direct(shot, white, REFERENCE, window)[..., 0].astype(np.float64) - share
            errors.append(difference.ravel())
        found = np.concatenate(errors)
        print(
            f"{camera.name}: mean error of the coverage {np.abs(found).mean():.5f}, bias {found.mean():+.5f}",
            flush=True,
        )


def _let_shine() -> None:
    """Let the cloth shine by itself, and all else be black."""
    data = import_bpy().data
    tree = data.materials["fabric"].node_tree
    glow = tree.nodes.new("ShaderNodeEmission")
    glow.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    tree.links.new(glow.outputs["Emission"], tree.nodes["Material Output"].inputs["Surface"])
    for hidden in ("lamp", "floor"):
        data.objects[hidden].hide_render = True
    for prop in ("holder-1", "holder-2"):
        black = data.materials[prop].node_tree.nodes["Principled BSDF"]
        black.inputs["Base Color"].default_value = (0.0, 0.0, 0.0, 1.0)
        black.inputs["Specular IOR Level"].default_value = 0.0


def corners(renderer: ClothRenderer, track: npt.NDArray[np.float64], rest: npt.NDArray[np.float32]) -> None:
    """Print how far apart the projected corners of the cloth are."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    low, high = rest.min(axis=0), rest.max(axis=0)
    places = np.array([(u, v) for u in (low[0], high[0]) for v in (low[1], high[1])])
    at = np.abs(rest[:, None] - places).sum(axis=2).argmin(axis=0)
    points = track[:, at].reshape(-1, 3)
    scene: Any = import_bpy().context.scene
    worst = 0.0
    for camera in load_rig("drag"):
        set_view(scene, camera)
        import_bpy().context.view_layer.update()
        theirs = np.array([world_to_camera_view(scene, scene.camera, Vector(point))[:2] for point in points.tolist()])
        pixels = theirs * [camera.width, -camera.height] + [-0.5, camera.height - 0.5]
        worst = max(worst, float(np.linalg.norm(pixels - camera.project(points)[0], axis=1).max()))
    print(f"corners: at most {worst:.5f} px apart, {len(points)} places, {len(load_rig('drag'))} cameras")


if __name__ == "__main__":
    main()
