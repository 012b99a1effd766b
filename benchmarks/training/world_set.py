"""Score a reader of friction on `cloth-2`.

The set has clips of Blender as a phone would film them, and clips without an answer.

    python benchmarks/training/world_set.py MODEL RUNS.npz FLOOR.npz ... --record RECORD.json

`clip_set.py cloth-2` makes the files, and calls this. RUNS.npz has simulations with a seed that was
never trained on. Every clip is read as it was rendered; with one thing at a time, drawn
from a fixed seed: a clamp, hands, a shadow, a focal length wrong by up to 3 %, a roll by up to 1.5
degrees, a camera that stands 1 cm elsewhere, H.264, noise and exposure; and with all of them. Then
sorts of clips without an answer are made of the same runs. None of them is one that the reader has
as an example.
"""

import argparse
import io
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.store import write_durably
from stickslip_training.cloth.clips import INSTANTS, Clips, clips_of_file, frames_at, render_clips
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.evaluation import errors
from stickslip_training.cloth.familiarity import glued, hanging, holders_at, reordered, sized
from stickslip_training.cloth.model import WEIGHTS, load_friction
from stickslip_training.cloth.posterior import estimates
from stickslip_training.cloth.runs import Runs, load_runs
from stickslip_training.cloth.video import holder_points

Random = np.random.Generator
SEED = 2033
COLUMNS = ("mae", "within_01", "within_02", "coverage", "interval")


def clamp(video: Any, camera: Camera, random: Random) -> Any:
    """Draw a bulldog clip over each held patch."""
    wide = random.uniform(6, 16) / 1000
    high = random.uniform(6, 16) / 1000
    level = random.uniform(20, 200)
    for frame, points in zip(video, holder_points(np.array(INSTANTS, dtype=float)), strict=True):
        pixels, depth = camera.project(points)
        for (u, v), far in zip(pixels, depth, strict=True):
            w = wide * camera.fx / far / 2
            h = high * camera.fx / far / 2
            box = np.array(
                [[u - w, v - h], [u + w, v - h], [u + 0.7 * w, v + h], [u - 0.7 * w, v + h]]
            )
            cv2.fillConvexPoly(frame, box.round().astype(np.int32), (level,) * 3, cv2.LINE_AA)
    return video


def hands(video: Any, camera: Camera, random: Random) -> Any:
    """Draw a fist and an arm over each held patch."""
    skin = np.array([1.0, 0.78, 0.65]) * random.uniform(70, 230)
    lean = random.uniform(-0.5, 0.5, 2)
    for frame, points in zip(video, holder_points(np.array(INSTANTS, dtype=float)), strict=True):
        pixels, depth = camera.project(points)
        for (u, v), far, side in zip(pixels, depth, lean, strict=True):
            m = camera.fx / far
            place = (round(u), round(v - 0.015 * m))
            end = (round(u + side * 0.2 * m), round(v - 0.25 * m))
            cv2.line(frame, place, end, skin.tolist(), max(2, round(0.03 * m)), cv2.LINE_AA)
            cv2.ellipse(
                frame,
                place,
                (round(0.017 * m), round(0.02 * m)),
                0,
                0,
                360,
                skin.tolist(),
                -1,
                cv2.LINE_AA,
            )
    return video


def shadow(video: Any, camera: Camera, random: Random) -> Any:
    """Darken what is beyond a soft line that stays, and a blot that moves."""
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    angle = random.uniform(0, 2 * np.pi)
    place = random.uniform(-50, 50)
    soft = random.uniform(2, 15)
    across = (columns - camera.cx) * np.cos(angle) + (rows - camera.cy) * np.sin(angle) - place
    still = 1 - random.uniform(0.2, 0.55) / (1 + np.exp(-across / soft))
    return np.clip(video * still[None, :, :, None], 0, 255).astype(np.uint8)


def warped(video: Any, camera: Camera, zoom: float, roll: float, shift: Any) -> Any:
    """Return the video of a camera that has another focal length, roll [degree] and place [px]."""
    matrix = cv2.getRotationMatrix2D((camera.cx, camera.cy), roll, zoom)
    matrix[:, 2] += shift
    size = (camera.width, camera.height)
    return np.stack(
        [
            cv2.warpAffine(frame, matrix, size, None, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
            for frame in video
        ]
    )


def focal(video: Any, camera: Camera, random: Random) -> Any:
    return warped(
        video, camera, 1 + random.choice([-1, 1]) * random.uniform(0.01, 0.03), 0.0, (0.0, 0.0)
    )


def roll(video: Any, camera: Camera, random: Random) -> Any:
    return warped(video, camera, 1.0, random.choice([-1, 1]) * random.uniform(0.5, 1.5), (0.0, 0.0))


def position(video: Any, camera: Camera, random: Random) -> Any:
    """Move the camera by 1 cm.

    The holders are off in the picture by about as much, and the registration corrects that.
    """
    return warped(
        video, camera, 1 + random.uniform(-0.007, 0.007), 0.0, random.uniform(-0.6, 0.6, 2)
    )


def h264(video: Any, camera: Camera, random: Random) -> Any:
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width = camera.width
        stream.height = camera.height
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(int(random.integers(23, 31)))}
        for frame in video:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        file.mux(stream.encode())
    buffer.seek(0)
    with av.open(buffer, "r") as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


def sensor(video: Any, camera: Camera, random: Random) -> Any:
    """Change exposure, white balance and gamma; blur, and add noise."""
    light = (
        (video / 255.0) ** random.uniform(0.8, 1.25)
        * random.uniform(0.75, 1.3)
        * random.uniform(0.9, 1.1, 3)
    )
    blurred = np.stack(
        [cv2.GaussianBlur(frame, (0, 0), random.uniform(0.3, 0.8)) for frame in light]
    )
    noise = random.normal(0, random.uniform(0.005, 0.02), video.shape)
    return np.clip(255 * (blurred + noise), 0, 255).astype(np.uint8)


FACTORS: dict[str, tuple[Callable[[Any, Camera, Random], Any], ...]] = {
    "as rendered": (),
    "clamp": (clamp,),
    "hands": (hands,),
    "shadow": (shadow,),
    "focal length": (focal,),
    "roll": (roll,),
    "position": (position,),
    "H.264": (h264,),
    "exposure, blur, noise": (sensor,),
    "all": (clamp, hands, shadow, focal, roll, position, sensor, h264),
}
"""`all` has clamps or hands, each in half of the clips."""


def filmed(path: Path, materials: tuple[str, ...], steps: tuple[Callable[..., Any], ...]) -> Clips:
    """Return the clips of a file after some steps."""
    clips, about = clips_of_file(path, materials)
    if not steps:
        return clips
    named = {camera.name: camera for camera in load_rig("drag")}
    with np.load(path) as file:
        videos = file["video"]
    crops = []
    for place, (video, about_clip) in enumerate(zip(videos, about, strict=True)):
        random = np.random.default_rng((SEED, place))
        camera = named[about_clip["viewpoint"]]
        holds = (clamp, hands)[random.integers(2)]
        for step in steps:
            if len(steps) == 1 or step not in (clamp, hands) or step is holds:
                video = step(np.ascontiguousarray(video.copy()), camera, random)
        crops.append(
            cut(grey(torch.from_numpy(video[None])), holder_crops(Cameras.of([camera]), INSTANTS))
        )
    return replace(clips, crops=torch.cat(crops))


def without_answer(runs: Runs) -> dict[str, Clips]:
    """Return clips of sorts that hold no answer, each in worlds of their own."""
    frames, _ = frames_at(runs.instants)
    runs = replace(runs, positions=runs.positions[:, frames], instants=INSTANTS)
    held = holders_at(INSTANTS)

    def render_worlds(positions: Any, seed: int) -> Clips:
        return render_clips(
            replace(runs, positions=positions.astype(np.float32)),
            2,
            SEED + seed,
            with_surroundings=True,
        )

    meshes = runs.positions
    lifted = hanging(meshes, held) + np.array([0, 0, 0.06], np.float32)
    swung = hanging(meshes, held)
    swung[..., 0] += 0.3 * (held[..., 2] - swung[..., 2])
    rigid = meshes[:, :1] - held[:1] + held
    narrow = meshes * np.array([1, 0.5, 1], np.float32)
    stiff = hanging(meshes, held)
    stiff[..., 0] += held[..., 2] - stiff[..., 2]
    stiff[..., 2] = held[..., 2]
    empty = meshes + np.array([0, 0, -9.0], np.float32)
    good = render_worlds(meshes, 0)
    lies = (meshes[:, 2:3, ..., 2:] < 0.004) & (np.arange(6) >= 2)[None, :, None, None, None]
    stuck = np.where(lies, meshes[:, 2:3], meshes)
    noise = torch.rand(good.crops.shape, generator=torch.Generator().manual_seed(SEED))
    return {
        "hangs free, 6 cm higher": render_worlds(lifted, 1),
        "hangs free, and leans": render_worlds(swung, 2),
        "a board that lies in the air": render_worlds(stiff, 3),
        "moves as one piece": render_worlds(rigid, 4),
        "half as wide": render_worlds(narrow, 5),
        "of two thirds the size": render_worlds(sized(meshes, held, 0.67), 6),
        "of half again the size": render_worlds(sized(meshes, held, 1.5), 7),
        "glued from the second leg on": render_worlds(stuck, 8),
        "glued all along": render_worlds(glued(meshes, held), 9),
        "half a leg out of phase": render_worlds(reordered(meshes, held, [1, 2, 3, 4, 5, 0]), 10),
        "no cloth": render_worlds(empty, 11),
        "upside down": replace(good, crops=good.crops.flip(2)),
        "a crop that is off by 6 and 8 px": replace(
            good, crops=torch.roll(good.crops, (6, 8), (2, 3))
        ),
        "noise": replace(good, crops=noise),
    }


def main() -> None:
    """Score, print the rows, and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("model", type=Path, nargs="?", default=WEIGHTS)
    parser.add_argument("runs", type=Path)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument(
        "--factors", nargs="+", choices=FACTORS, default=list(FACTORS), metavar="FACTOR"
    )
    parser.add_argument("--record", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load_friction(args.model)
    rows: dict[str, Any] = {}
    started = time.process_time()
    for name in args.factors:
        films = [
            (f" / {path.stem}", filmed(path, model.materials, FACTORS[name])) for path in args.clips
        ]
        for floor, clips in [("", Clips.joined([clips for _, clips in films])), *films]:
            estimate = estimates(model.estimate(clips).mu, model.bins)
            scores = errors(estimate, clips.mu, clips.run)
            refused = sum(reason is not None for reason in model.judge(clips)[1])
            rows[name + floor] = {
                "clips": scores.clips,
                "simulations": scores.simulations,
                **{each: round(getattr(scores, each).value, 3) for each in COLUMNS},
                "no_answer": round(refused / len(clips), 3),
            }
            print(name + floor, rows[name + floor], flush=True)
    flagged: dict[str, Any] = {}
    for name, clips in without_answer(load_runs(args.runs).named(model.materials)).items():
        reasons = model.judge(clips)[1]
        flagged[name] = round(float(np.mean([reason is not None for reason in reasons])), 3)
        print(name, flagged[name], sorted({reason for reason in reasons if reason}), flush=True)
    flagged["all"] = round(float(np.mean(list(flagged.values()))), 3)
    print("without an answer", flagged["all"], f"{time.process_time() - started:.0f} CPU s")
    if args.record is not None:
        listed = [{"clips of": name, **row} for name, row in rows.items()]
        listed += [
            {"sort without an answer": name, "flagged": share} for name, share in flagged.items()
        ]
        record = {"rows": listed}
        write_durably(args.record, (json.dumps(record, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
