"""What a phone's video costs: the same simulations as films and as clips, measured by one model.

    python benchmarks/training/phone_video.py meshes RUNS.npz MESHES.npz --only RUN ...
    $BLENDER_PY benchmarks/training/blender_clips.py MESHES.npz FILMS.npz --textures 1 --instants all --clips N
    python benchmarks/training/phone_video.py measure FILMS.npz [--model MODEL] [--records FILE.jsonl]

RUNS.npz is of `cloth_runs.py --pack`. `meshes` writes the meshes of every frame of a film: five a second, from before
the stage starts, at times that no clip shows. After them come the instants of a clip. Blender renders both with one
look. `measure` makes an H.264 film of the former, as a hand holds a phone, imports it by `cloth import`'s own code, and
compares.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from stickslip_schemas.spec.cameras import load_rig
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.evaluation import predictions
from stickslip_training.cloth.runs import grid_order, load_runs, write_packed
from stickslip_training.cloth.training import INSTANTS, RIG, WEIGHTS, FrictionModel, load_friction
from stickslip_training.cloth.video import RATE, Calibration, VideoError, import_video, load_clip, save_clip
from stickslip_training.testing import meshes_at, write_film

START, FRAMES_A_SECOND, DISTORTION = 1.7, 5, (-0.12, 0.05, 0.001, -0.0005, 0.0)
SHAKE = 0.05
"""Standard deviation of a hand's steps from frame to frame, a walk [px]: 1 px after 67 s."""


def meshes(runs_file: Path, out: Path, only: list[int]) -> None:
    """Write the meshes of films and clips as a packed file of runs, whose instants are the numbers of the pictures."""
    runs = load_runs(runs_file)
    film = np.arange(0.0, START + INSTANTS[-1] / RATE + 1.0, 1 / FRAMES_A_SECOND) - START
    seconds = np.concatenate([film, np.array(INSTANTS) / RATE])
    positions = np.stack([meshes_at(runs[np.array([run])], seconds).reshape(len(seconds), -1, 3) for run in only])
    with np.load(runs_file) as file:
        order = grid_order(file["rest"]).ravel()
        about = [str(line) for line in file["about"][only]]
        triangles = np.argsort(order)[file["triangles"]]
        write_packed(out, positions, file["rest"][order], triangles, range(len(seconds)), about)
    print(f"{out}: {len(only)} runs, {len(film)} frames of a film and {len(INSTANTS)} of a clip each")


def measure(films: Path, model: FrictionModel, records: Path | None) -> None:
    """Print what the model says of films and of clips."""
    with np.load(films) as file:
        videos, about = file["video"], [json.loads(str(line)) for line in file["about"]]
    named = {camera.name: camera for camera in load_rig(RIG)}
    answers = []
    for number, (video, true) in enumerate(zip(videos, about, strict=True)):
        camera = named[true["viewpoint"]]
        frames, clip = video[: -len(INSTANTS)], video[-len(INSTANTS) :]
        shake = np.random.default_rng(number).normal(0.0, SHAKE, (len(frames), 2)).cumsum(axis=0)
        calibration = Calibration(camera, DISTORTION)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            write_film(path, frames, camera, rate=FRAMES_A_SECOND, distortion=DISTORTION, shake=shake - shake[0])
            try:
                crops, instants, found = import_video(path, calibration)
            except VideoError as error:
                print(f"film {number}, {true['viewpoint']}, {true['texture']}: refused: {error}", flush=True)
                answers.append({**true, "refused": str(error)})
                continue
            save_clip(Path(folder) / "clip.npz", crops, instants, calibration, found)
            imported = load_clip(Path(folder) / "clip.npz")
        seen = Cameras.of([camera])
        direct = cut(grey(torch.from_numpy(clip[None])), holder_crops(seen, INSTANTS))
        pictures = replace(imported, crops=direct, direction=seen.rotation[:, 2])
        film_mu, clip_mu = (predictions(model.estimate(each), [0])[0]["mu"]["median"] for each in (imported, pictures))
        answers.append({**true, "film": film_mu, "clip": clip_mu, "start": found.start, "residual": found.residual})
        print(
            f"{true['material']}, {true['viewpoint']}, {true['texture']}: mu {true['mu']:.2f}, film {film_mu:.2f}, "
            f"clip {clip_mu:.2f}; start {found.start:.2f} s, residual {found.residual:.2f} px",
            flush=True,
        )
    if records is not None:
        records.write_text("".join(json.dumps(answer) + "\n" for answer in answers))
    known = [each for each in answers if "film" in each]
    mu, film_mu, clip_mu = (np.array([each[name] for each in known]) for name in ("mu", "film", "clip"))
    print(
        f"{len(known)} of {len(answers)} films measured. Mean error: films {np.abs(film_mu - mu).mean():.3f}, clips "
        f"{np.abs(clip_mu - mu).mean():.3f}; film against clip {np.abs(film_mu - clip_mu).mean():.3f} (largest "
        f"{np.abs(film_mu - clip_mu).max():.3f})"
    )


def main() -> None:
    """Write meshes, or measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    actions = parser.add_subparsers(dest="action", required=True)
    first = actions.add_parser("meshes")
    first.add_argument("runs", type=Path)
    first.add_argument("out", type=Path)
    first.add_argument("--only", type=int, nargs="+", required=True, help="numbers of the runs")
    second = actions.add_parser("measure")
    second.add_argument("films", type=Path)
    second.add_argument("--model", type=Path, default=WEIGHTS)
    second.add_argument("--records", type=Path)
    args = parser.parse_args()
    if args.action == "meshes":
        meshes(args.runs, args.out, args.only)
    else:
        measure(args.films, load_friction(args.model), args.records)


if __name__ == "__main__":
    main()
