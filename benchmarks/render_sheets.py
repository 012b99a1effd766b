"""Moving sheets of what cloth looks like: fabrics, substrates, and what is held out for tests.

    .venv-blender/bin/python benchmarks/render_sheets.py FOLDER OUT [--frames 12] [--quality draft]

FOLDER has a trajectory MATERIAL.npz for each fabric that is to be shown, from `benchmarks/render_trajectory.py
FOLDER/MATERIAL.npz --material MATERIAL --mu 0.5`, all on one mesh; the first serves for substrates and for what is held
out. OUT gets animated WebP files with labels; that of the substrates says what the image gate found.
"""

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from stickslip_blender.clips import ClothRenderer
from stickslip_blender.holders import Holders
from stickslip_blender.preview import sheet
from stickslip_blender.textures import texture_image
from stickslip_schemas.kinds.cloth.drag_scene import HELD_OUT_VIEWPOINTS
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.appearance import shown_frames
from stickslip_schemas.spec.cameras import load_rig, rig_digest
from stickslip_schemas.spec.fabrics import HELD_OUT_TEXTURES, Texture
from stickslip_schemas.spec.jobs import Quality

Clip = npt.NDArray[np.uint8]

SIDE = 128
CUT, CLOSE = 132, 176
"""Of a close view: the side that is cut out of a frame, and what it is made [px]."""
SUBSTRATES = (
    "matt",
    "aluminium",
    "aluminium-pet",
    "ceramic",
    "rough-glass",
    "smooth-glass",
    "polyester-mirror",
    "stainless-steel",
    "cloth",
)
VIEWS = ("azimuth-minus-15", "azimuth-plus-15", "elevation-minus-15", "elevation-plus-15")
assert set(VIEWS) <= {str(view) for view in HELD_OUT_VIEWPOINTS}


class Studio:
    """A stage on which all trajectories of one mesh are rendered."""

    def __init__(self, folder: Path, frames: int, quality: Quality) -> None:
        self.tracks: dict[str, npt.NDArray[np.float64]] = {}
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as file:
                self.tracks[path.stem] = file["track"].astype(np.float64)
                self._mesh = file["triangles"], file["rest"]
        self._renderer = ClothRenderer(*self._mesh, Holders)
        self._frames, self._quality = frames, quality

    def clips(
        self, material: str, textures: Sequence[Texture], *, close: bool = False, **look: object
    ) -> tuple[list[Clip], float]:
        """Return a fabric's clips with textures, made small, and what the image gate found.

        Close: instead of the whole frame, what is around the cloth, made larger.
        """
        track = self.tracks[material]
        document = ClothDragRender.model_validate(
            {
                "rig": "drag",
                "rig_digest": rig_digest("drag"),
                "quality": self._quality,
                "material": material,
                "texture": textures[0],
                "viewpoint": "calibrated",
                "instants": shown_frames(self._frames, len(track)),
                "light_seed": 4,
                "crease_seed": 4,
                **look,
            }
        )
        (camera,) = (camera for camera in load_rig("drag") if camera.name == document.viewpoint)
        clip = self._renderer.clip(document, camera, track[list(document.instants)])
        shading = clip.shading()
        videos, _ = clip.clips(shading, [texture_image(texture) for texture in textures])
        if close:
            boxes = [_around(camera.project(positions)[0]) for positions in track[list(document.instants)]]
            return [_resized(video, CLOSE, boxes) for video in videos], shading.gate_db
        whole = [(0, 0, camera.width, camera.height)] * len(document.instants)
        return [_resized(video, SIDE, whole) for video in videos], shading.gate_db


def _around(pixels: npt.NDArray[np.float64]) -> tuple[int, int, int, int]:
    """Return the square about the cloth's middle, of a side that all cloths fit in."""
    x, y = ((pixels.min(axis=0) + pixels.max(axis=0)) / 2.0).astype(int).tolist()
    return x - CUT // 2, y - CUT // 2, x + CUT // 2, y + CUT // 2


def _resized(video: Clip, side: int, boxes: Sequence[tuple[int, int, int, int]]) -> Clip:
    method = Image.Resampling.BOX if side == SIDE else Image.Resampling.BICUBIC
    frames = [
        Image.fromarray(frame).crop(box).resize((side, side), method) for frame, box in zip(video, boxes, strict=True)
    ]
    return np.stack([np.asarray(frame) for frame in frames])


def save(path: Path, tiles: Sequence[tuple[str, Clip]], columns: int) -> None:
    """Write a sheet of labelled clips, row by row."""
    empty = ("", np.full_like(tiles[0][1], 255))
    tiles = [*tiles, *[empty] * (-len(tiles) % columns)]
    rows = [tiles[first : first + columns] for first in range(0, len(tiles), columns)]
    pictures = sheet([[clip for _, clip in row] for row in rows], [[text for text, _ in row] for row in rows])
    frames = [Image.fromarray(frame) for frame in pictures]
    file = io.BytesIO()
    frames[0].save(
        file, format="WEBP", save_all=True, append_images=frames[1:], duration=300, loop=0, quality=40, method=4
    )
    path.write_bytes(file.getvalue())
    print(f"{path}: {len(file.getvalue()) / 1e3:.0f} kB, {frames[0].size[0]} x {frames[0].size[1]}", flush=True)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("out", type=Path)
    arguments.add_argument("--frames", type=int, default=12)
    arguments.add_argument("--fabrics", action="store_true", help="only the sheet of fabrics")
    arguments.add_argument("--quality", type=Quality, default=Quality.draft)
    options = arguments.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    studio = Studio(options.folder, options.frames, options.quality)

    tiles = [(name, studio.clips(name, (Texture.gingham,), close=True)[0][0]) for name in studio.tracks]
    save(options.out / "cloth-fabrics.webp", tiles, 5)
    if options.fabrics:
        return

    material = next(iter(studio.tracks))
    tiles = []
    for substrate in SUBSTRATES:
        (clip,), gate = studio.clips(material, (Texture.plaid,), substrate=substrate)
        tiles.append((f"{substrate} {gate:.1f}", clip))
    save(options.out / "cloth-substrates.webp", tiles, 5)

    textures = tuple(HELD_OUT_TEXTURES)
    tiles = [(str(name), clip) for name, clip in zip(textures, studio.clips(material, textures)[0], strict=True)]
    for seed in range(2):
        (clip,), _ = studio.clips(material, (Texture.plaid,), lighting="held-out", light_seed=seed)
        tiles.append((f"held-out lamp {seed + 1}", clip))
    for view in VIEWS:
        (clip,), _ = studio.clips(material, (Texture.plaid,), viewpoint=view)
        tiles.append((view, clip))
    save(options.out / "cloth-held-out.webp", tiles, 5)


if __name__ == "__main__":
    main()
