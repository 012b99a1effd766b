"""What a phone's films cost: the same simulations as films and as clips, read by one model.

    python benchmarks/training/phone_films.py meshes RUNS.npz MESHES.npz --only RUN ... $BLENDER_PY
    benchmarks/training/blender_clips.py MESHES.npz FILMS.npz --instants all --clips N python
    benchmarks/training/phone_films.py measure FILMS.npz ... [--model MODEL] [--record RECORD.json]

RUNS.npz is of `cloth_runs.py --pack`. `meshes` writes the meshes of every frame of a film: nine a
second, from before the holders start. After them come the instants of a clip. Blender renders both
with one look. `measure` makes an H.264 film of the former, through a lens, as a hand holds a phone,
and reads it as `cloth predict --camera` does. It reads the film again with half a second cut off
either end.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cloth_runs import write_packed
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.store import write_durably
from stickslip_testing.films import meshes_at, write_film
from stickslip_training.cloth.clips import INSTANTS, RATE, RIG, Clips
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.evaluation import errors, predictions
from stickslip_training.cloth.model import WEIGHTS, FrictionModel, load_friction
from stickslip_training.cloth.posterior import Estimates
from stickslip_training.cloth.runs import STEP, grid_order, load_runs
from stickslip_training.cloth.video import import_video

START = 1.7
FRAMES_A_SECOND = 9
DISTORTION = (-0.12, 0.05, 0.001, -0.0005, 0.0)
SHAKE = 0.05
"""Standard deviation of a hand's steps from frame to frame, a walk [px]: 1.5 px after 95 s."""

CLIP = "frames at the instants, without a phone"

VARIANTS = {"whole": (0, 0), "start cut by 0.5 s": (20, 0), "end cut by 0.5 s": (0, 14)}
"""Frames that are left out at the start and at the end. The holders start in frame 15, and nine
frames follow the last instant that is read."""


def meshes(source: Path, out: Path, only: list[int]) -> None:
    """Write the meshes of films and clips as a packed file of runs.

    The instants of the file are the numbers of the pictures.
    """
    runs = load_runs(source)
    film = np.arange(0.0, START + INSTANTS[-1] / RATE + 1.0, 1 / FRAMES_A_SECOND) - START
    seconds = np.concatenate([film, np.array(INSTANTS) / RATE])
    positions = np.stack(
        [meshes_at(runs[np.array([run])], seconds).reshape(len(seconds), -1, 3) for run in only]
    )
    with np.load(source) as file:
        order = grid_order(file["rest"]).ravel()
        mesh = {
            "rest": file["rest"][order],
            "triangles": np.argsort(order)[file["triangles"]].astype(np.int16),
            "instants": np.arange(len(seconds), dtype=np.int16),
        }
        write_packed(
            out, np.rint(positions / STEP).astype(np.int16), mesh, file["about"][only].tolist()
        )
    print(
        f"{out}: {len(only)} runs, {len(film)} frames of a film and {len(INSTANTS)} of a clip each"
    )


def answers(video: Any, true: dict[str, Any], number: int, model: FrictionModel) -> dict[str, Any]:
    """Return the answers of a model for a film, its variants, and the clip at its end.

    `video` is (F, H, W, 3).

    An answer is mu with its interval, why there is none, or why the film is refused.
    """
    camera = next(camera for camera in load_rig(RIG) if camera.name == true["viewpoint"])
    lens = Camera.model_validate({**camera.model_dump(), "distortion": DISTORTION})
    frames = video[: -len(INSTANTS)]
    clip = video[-len(INSTANTS) :]
    shake = np.random.default_rng(number).normal(0.0, SHAKE, (len(frames), 2)).cumsum(axis=0)
    answers_of_film = {name: true[name] for name in ("viewpoint", "texture", "material", "mu")}
    imported = None

    def answer(clips: Clips) -> list[float] | str:
        prediction = predictions(model.estimate(clips), [0], model.judge(clips))[0]
        return prediction["no_answer"] or [
            prediction["mu"][name] for name in ("median", "low", "high")
        ]

    for name, (first, last) in VARIANTS.items():
        frame_range = slice(first, len(frames) - last)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            moved = shake[frame_range] - shake[first]
            write_film(
                path,
                frames[frame_range],
                camera,
                rate=FRAMES_A_SECOND,
                distortion=DISTORTION,
                shake=moved,
            )
            try:
                imported = import_video(path, lens)[0]
            except ValueError as error:
                answers_of_film[name] = f"refused: {error}"
            else:
                answers_of_film[name] = answer(imported)
    if imported is not None:
        cameras = Cameras.of([camera])
        crops = cut(grey(torch.from_numpy(clip[None])), holder_crops(cameras, INSTANTS))
        answers_of_film[CLIP] = answer(
            replace(imported, crops=crops, direction=cameras.rotation[:, 2])
        )
    return answers_of_film


def summary(films: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Return the errors of the answers to the films, to a variant of them or to the clips."""
    answers_to_films = [film.get(name, "refused: as the film") for film in films]
    read = [place for place, each in enumerate(answers_to_films) if not isinstance(each, str)]
    refused = sum(isinstance(each, str) and each.startswith("refused") for each in answers_to_films)
    row: dict[str, Any] = {
        "clips of": name,
        "refused": refused,
        "no_answer": len(answers_to_films) - len(read) - refused,
    }
    if read:
        mu = np.array([films[place]["mu"] for place in read])
        scores = errors(
            Estimates(*np.array([answers_to_films[place] for place in read]).T),
            mu,
            np.unique(mu, return_inverse=True)[1],
        )
        row |= {"clips": scores.clips, "simulations": scores.simulations}
        row |= {
            each: round(getattr(scores, each).value, 3) for each in ("mae", "within_01", "coverage")
        }
        whole = [(answers_to_films[place][0], films[place]["whole"]) for place in read]
        off = [abs(median - film[0]) for median, film in whole if not isinstance(film, str)]
        row["from_whole"] = {"mean": round(float(np.mean(off)), 4), "largest": round(max(off), 4)}
    return row


def measure(films: list[Path], model: FrictionModel, record: Path | None) -> None:
    """Print the errors of films, of their variants and of clips."""
    answered: list[dict[str, Any]] = []
    for path in films:
        with np.load(path) as file:
            videos = file["video"]
            about = [json.loads(str(line)) for line in file["about"]]
        for video, true in zip(videos, about, strict=True):
            answered.append({"floor": path.stem} | answers(video, true, len(answered), model))
            print(json.dumps(answered[-1]), flush=True)
    rows = [summary(answered, name) for name in [*VARIANTS, CLIP]]
    print(json.dumps(rows, indent=1))
    if record is not None:
        write_durably(record, (json.dumps({"rows": rows + answered}, indent=1) + "\n").encode())


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
