"""Photographs of a user: a folder with one picture for each camera of a calibration file.

A picture has the name of its camera.
"""

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from stickslip_schemas.installation import install_hint
from stickslip_schemas.spec.cameras import Camera, read_rigs

from stickslip_training.reconstruction.pipeline import Reconstruction, reconstruct
from stickslip_training.reconstruction.views import ReconstructionError

RECONSTRUCTED = (0, 255, 255)
TRUE = (255, 60, 255)
"""Colours of centrelines."""
LEAST_HEIGHT = 600  # [px]: smaller pictures are enlarged by a whole factor


def import_pillow() -> Any:
    """Return PIL.Image; raise ImportError with the way to install it."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ImportError(
            "Pillow is missing: " + install_hint("stickslip-training", "images")
        ) from error
    return Image


def save_overlay(
    path: Path,
    views: Sequence[npt.NDArray[np.uint8]],
    cameras: Sequence[Camera],
    centerline: npt.NDArray[np.float64],
    true: npt.NDArray[np.float64] | None = None,
) -> None:
    """Write a PNG of the views (y, x, rgb) side by side, with centrelines over them.

    The reconstructed centreline (n, 3) [camera unit] is drawn over the true one, if that is known.
    """
    module = import_pillow()
    from PIL import ImageDraw

    curves = (
        [(centerline, RECONSTRUCTED)]
        if true is None
        else [(true, TRUE), (centerline, RECONSTRUCTED)]
    )
    panels = []
    for pixels, camera in zip(views, cameras, strict=True):
        factor = max(1, round(LEAST_HEIGHT / camera.height))
        panel = module.fromarray(np.asarray(pixels)).convert("RGB")
        panel = panel.resize(
            (camera.width * factor, camera.height * factor), module.Resampling.NEAREST
        )
        pen = ImageDraw.Draw(panel)
        for points, color in curves:
            line = (camera.project(points)[0] + 0.5) * factor - 0.5
            pen.line(
                [tuple(point) for point in line.tolist()],
                fill=color,
                width=max(1, camera.height // 800),
            )
        panels.append(panel)
    sheet = module.new(
        "RGB", (sum(panel.width for panel in panels), max(panel.height for panel in panels))
    )
    left = 0
    for panel in panels:
        sheet.paste(panel, (left, 0))
        left += panel.width
    sheet.save(path)


ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class FolderReconstruction:
    """Result of a folder: the reconstruction, and its sources."""

    reconstruction: Reconstruction
    cameras: tuple[Camera, ...]
    views: list[npt.NDArray[np.uint8]]
    """Pictures (y, x, rgb) in the order of the cameras."""
    length: float
    """In the unit of the calibration."""


def reconstruct_folder(
    folder: str | Path,
    calibration: str | Path,
    *,
    length: float,
    rig: str | None = None,
    **options: Any,
) -> FolderReconstruction:
    """Reconstruct the rod in the photographs of a folder.

    The calibration is laid out as `rigs/rod-4.toml` of the schemas; `rig` says which of its rigs,
    if it has several. Lengths and positions are in its unit; `options` go to `reconstruct`.
    Photographs must have been freed of lens distortion.
    """
    cameras = read_calibration(calibration, rig)
    views = [read_photograph(Path(folder), camera) for camera in cameras]
    return FolderReconstruction(
        reconstruct(views, cameras, length=length, **options), cameras, views, length
    )


def read_calibration(path: str | Path, rig: str | None = None) -> tuple[Camera, ...]:
    """Return the cameras of a rig of a calibration file.

    Errors name the field, the rule and the value.
    """
    try:
        rigs = read_rigs(path)
    except ValidationError as error:
        problems = [
            f"{'.'.join(map(str, item['loc']))}: {item['msg']}; got {item['input']}"
            for item in error.errors(include_url=False)
        ]
        raise ReconstructionError(f"{path}: " + "\n  ".join(problems)) from error
    except tomllib.TOMLDecodeError as error:
        raise ReconstructionError(f"{path}: not TOML: {error}") from error
    names = ", ".join(rigs)
    if rig is None:
        if len(rigs) != 1:
            raise ReconstructionError(
                f"rig must be given where a calibration has several; {path} has {names}"
            )
        rig = next(iter(rigs))
    if rig not in rigs:
        raise ReconstructionError(f"rig must be one of {names} in {path}; got {rig}")
    for camera in rigs[rig]:
        if any(camera.distortion):
            raise ReconstructionError(
                "distortion must be 0: undistort the photographs (cv2.undistort); that of "
                f"{camera.name} in {path} is "
                f"{list(camera.distortion)}"
            )
    return rigs[rig]


def read_photograph(folder: Path, camera: Camera) -> npt.NDArray[np.uint8]:
    """Return the picture of a camera in a folder, (y, x, rgb), upright as its EXIF says."""
    image = import_pillow()
    from PIL import ImageOps

    named = [
        path
        for path in sorted(folder.glob("*"))
        if path.stem == camera.name and path.suffix.lower() in ENDINGS
    ]
    if len(named) != 1:
        wanted = " or ".join(camera.name + ending for ending in ENDINGS)
        raise ReconstructionError(f"{folder} must hold one picture {wanted}; found {len(named)}")
    with image.open(named[0]) as photograph:
        return np.asarray(ImageOps.exif_transpose(photograph).convert("RGB"))


def write_results(result: FolderReconstruction, out: Path) -> list[str]:
    """Write centerline.csv, centerline.npz, overlay.png and report.json; return their names."""
    out.mkdir(parents=True, exist_ok=True)
    reconstruction = result.reconstruction
    s = np.linspace(0.0, result.length, len(reconstruction.centerline))
    table = np.column_stack(
        [s, reconstruction.centerline, reconstruction.deviation, reconstruction.views_seen]
    )
    header = "arc_length,x,y,z,deviation,views_seen"
    np.savetxt(
        out / "centerline.csv",
        table,
        fmt=["%.9g"] * 5 + ["%d"],
        delimiter=",",
        header=header,
        comments="",
    )
    arrays: dict[str, Any] = {
        name: getattr(reconstruction, name) for name in ("deviation", "residual", "views_seen")
    }
    np.savez(out / "centerline.npz", arc_length=s, centerline=reconstruction.centerline, **arrays)
    save_overlay(out / "overlay.png", result.views, result.cameras, reconstruction.centerline)
    report = {
        "verdict": reconstruction.verdict.value,
        "reasons": list(reconstruction.reasons),
        "length": result.length,
        "radius": reconstruction.radius,
        "points": len(reconstruction.centerline),
        "misfit": reconstruction.misfit,
        "unexplained": reconstruction.unexplained,
        "unsupported": reconstruction.unsupported,
        "rival": reconstruction.rival if np.isfinite(reconstruction.rival) else None,
        "residual_rms_px": reconstruction.residual_rms,
        "residual_rms_px_by_view": {
            camera.name: float(np.sqrt(np.nanmean(row**2))) if np.isfinite(row).any() else None
            for camera, row in zip(result.cameras, reconstruction.residual, strict=True)
        },
        "median_deviation": float(np.median(reconstruction.deviation)),
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return ["centerline.csv", "centerline.npz", "overlay.png", "report.json"]
