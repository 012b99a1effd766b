"""What a phone's films cost: the same simulations as films and as clips, read by one model.

    python benchmarks/training/phone_films.py meshes RUNS.npz MESHES.npz --only RUN ...
    $BLENDER_PY benchmarks/training/blender_clips.py MESHES.npz FILMS.npz --instants all --clips N
    python benchmarks/training/phone_films.py measure FILMS.npz ... [--model MODEL] [--record RECORD.json]

RUNS.npz is of `cloth_runs.py --pack`. `meshes` writes the meshes of every frame of a film: nine a second, from before
the holders start. After them come the instants of a clip. Blender renders both with one look. `measure` makes an H.264
film of the former, through a lens, as a hand holds a phone, and reads it as `cloth predict --camera` does. It reads the
film again with half a second cut off either end.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_testing.films import meshes_at, write_film
from stickslip_training.cloth.clips import INSTANTS, RATE, RIG
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.evaluation import predictions
from stickslip_training.cloth.model import WEIGHTS, FrictionModel, load_friction
from stickslip_training.cloth.runs import STEP, grid_order, load_runs
from stickslip_training.cloth.video import import_video

START, FRAMES_A_SECOND, DISTORTION = 1.7, 9, (-0.12, 0.05, 0.001, -0.0005, 0.0)
SHAKE = 0.05
"""Standard deviation of a hand's steps from frame to frame, a walk [px]: 1.5 px after 95 s."""

VARIANTS = {"whole": (0, 0), "start cut by 0.5 s": (20, 0), "end cut by 0.5 s": (0, 14)}
"""Frames that are left out at the start and at the end. The holders start in frame 15, and nine frames follow the last
instant that is read."""


def meshes(source: Path, out: Path, only: list[int]) -> None:
    """Write the meshes of films and clips as a packed file of runs, whose instants are the numbers of the pictures."""
    runs = load_runs(source)
    film = np.arange(0.0, START + INSTANTS[-1] / RATE + 1.0, 1 / FRAMES_A_SECOND) - START
    seconds = np.concatenate([film, np.array(INSTANTS) / RATE])
    positions = np.stack([meshes_at(runs[np.array([run])], seconds).reshape(len(seconds), -1, 3) for run in only])
    steps = np.diff(np.rint(positions / STEP).astype(np.int16), axis=1, prepend=np.int16(0))
    with np.load(source) as file:
        order = grid_order(file["rest"]).ravel()
        np.savez_compressed(
            out,
            differences=np.moveaxis(np.ascontiguousarray(steps)[..., None].view(np.uint8), -1, 0),
            rest=file["rest"][order],
            triangles=np.argsort(order)[file["triangles"]].astype(np.int16),
            instants=np.arange(len(seconds), dtype=np.int16),
            about=file["about"][only],
        )
    print(f"{out}: {len(only)} runs, {len(film)} frames of a film and {len(INSTANTS)} of a clip each")


def answers(video: Any, true: dict[str, Any], number: int, model: FrictionModel) -> dict[str, Any]:
    """Return what the model says of a film, of its variants and of the clip that ends `video` (F, H, W, 3)."""
    camera = next(camera for camera in load_rig(RIG) if camera.name == true["viewpoint"])
    lens = Camera.model_validate({**camera.model_dump(), "distortion": DISTORTION})
    frames, clip = video[: -len(INSTANTS)], video[-len(INSTANTS) :]
    shake = np.random.default_rng(number).normal(0.0, SHAKE, (len(frames), 2)).cumsum(axis=0)
    seen, told, imported = Cameras.of([camera]), dict(true), None

    def answer(clips: Any) -> dict[str, Any]:
        return {key: predictions(model.estimate(clips), [0], model.judge(clips))[0][key] for key in ("mu", "no_answer")}

    for name, (first, last) in VARIANTS.items():
        some = slice(first, len(frames) - last)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            moved = shake[some] - shake[first]
            write_film(path, frames[some], camera, rate=FRAMES_A_SECOND, distortion=DISTORTION, shake=moved)
            try:
                found, registration = import_video(path, lens)
            except ValueError as error:
                told[name] = {"refused": str(error)}
                continue
        told[name] = {**answer(found), "start": registration.start + first / FRAMES_A_SECOND}
        imported = imported or found
    if imported is not None:
        crops = cut(grey(torch.from_numpy(clip[None])), holder_crops(seen, tuple(map(float, INSTANTS))))
        told["clip"] = answer(replace(imported, crops=crops, direction=seen.rotation[:, 2]))
    return told


def measure(films: list[Path], model: FrictionModel, record: Path | None) -> None:
    """Print the errors of films, of their variants and of clips."""
    told: list[dict[str, Any]] = []
    for path in films:
        with np.load(path) as file:
            videos, about = file["video"], [json.loads(str(line)) for line in file["about"]]
        for video, true in zip(videos, about, strict=True):
            told.append(answers(video, true | {"file": path.stem}, len(told), model))
            print(json.dumps(told[-1]), flush=True)
    summary: dict[str, Any] = {"films": len(told)}
    for name in [*VARIANTS, "clip"]:
        read = [(each, each[name]["mu"]) for each in told if each.get(name, {}).get("mu")]
        off = np.array([abs(mu["median"] - each["mu"]) for each, mu in read])
        held = np.array([mu["low"] <= each["mu"] <= mu["high"] for each, mu in read])
        part: dict[str, Any] = {
            "refused": sum("refused" in each.get(name, {}) for each in told),
            "no_answer": sum(bool(each.get(name, {}).get("no_answer")) for each in told),
            "read": len(read),
        }
        if read:
            part |= {"mae": round(float(off.mean()), 3), "within_01": round(float((off < 0.1).mean()), 3)}
            part["coverage"] = round(float(held.mean()), 3)
        both = [abs(mu["median"] - each["whole"]["mu"]["median"]) for each, mu in read if each["whole"].get("mu")]
        if both and name != "whole":
            part["from_whole"] = {"mean": round(float(np.mean(both)), 4), "largest": round(float(max(both)), 4)}
        summary[name] = part
    print(json.dumps(summary, indent=1))
    if record is not None:
        record.write_text(json.dumps({"summary": summary, "films": told}, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Write meshes, or measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    actions = parser.add_subparsers(dest="action", required=True)
    first = actions.add_parser("meshes")
    first.add_argument("runs", type=Path)
    first.add_argument("out", type=Path)
    first.add_argument("--only", type=int, nargs="+", required=True, help="numbers of the runs")
    second = actions.add_parser("measure")
    second.add_argument("films", type=Path, nargs="+")
    second.add_argument("--model", type=Path, default=WEIGHTS)
    second.add_argument("--record", type=Path)
    args = parser.parse_args()
    if args.action == "meshes":
        meshes(args.runs, args.out, args.only)
    else:
        measure(args.films, load_friction(args.model), args.record)


if __name__ == "__main__":
    main()
