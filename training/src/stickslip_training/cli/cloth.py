"""The commands `stickslip-train cloth ...`: friction and material of dragged cloth from video."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Console
from rich.table import Table

from stickslip_training.cli.shared import readable_errors, report_epochs
from stickslip_training.data.reader import DatasetReader, Split

if TYPE_CHECKING:
    from stickslip_training.cloth.clips import Clips
    from stickslip_training.cloth.model import FrictionModel
    from stickslip_training.cloth.scope import Scope

NO_ANSWER = 3
"""Exit status of `predict` if no clip has an answer."""

cloth = typer.Typer(
    no_args_is_help=True, help="Measure friction and material of dragged cloth from video."
)

RunsArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUNS",
        help="a dataset that stores positions, or a packed file of simulations (.npz)",
    ),
]


@cloth.command()
def train(
    runs: RunsArgument,
    out: Annotated[
        Path, typer.Option(help="directory for the model, the checkpoint and the report")
    ],
    validation: Annotated[
        str | None,
        typer.Option(help="a packed file of simulations to validate; a dataset has a split for it"),
    ] = None,
    steps: Annotated[int, typer.Option(help="of training")] = 1500,
    batch: Annotated[int, typer.Option(help="clips of a step; 256 keep a GPU busy")] = 16,
    width: Annotated[int, typer.Option(help="of the network, a multiple of 48")] = 96,
    seed: Annotated[int, typer.Option(help="of the weights and of all that is drawn")] = 0,
    threads: Annotated[int, typer.Option(help="of torch")] = 2,
    device: Annotated[str, typer.Option(help="of torch: cpu, cuda")] = "cpu",
    clips: Annotated[
        list[str] | None,
        typer.Option(
            help=(
                "train on these clips of Blender, too: a dataset, or files of "
                "blender_clips.py (.npz)"
            )
        ),
    ] = None,
    start: Annotated[
        list[Path] | None,
        typer.Option(
            help="a friction.safetensors whose weights are the first; of several, the mean"
        ),
    ] = None,
    rate: Annotated[
        float, typer.Option(help="of learning, the highest; smaller where a model goes on")
    ] = 2e-3,
    resume: Annotated[
        bool, typer.Option("--resume", help="go on from the checkpoint in --out")
    ] = False,
) -> None:
    """Train a network that estimates material and friction.

    It learns from pictures that are rendered from simulations while it trains.
    """
    from stickslip_schemas.base import sha256

    from stickslip_training.cloth.clips import training_clips, training_runs
    from stickslip_training.cloth.learner import ClothTraining, train_friction
    from stickslip_training.cloth.model import load_friction, mean_model, save_friction
    from stickslip_training.engine.fit import write_report

    console = Console()
    with readable_errors():
        settings = ClothTraining(
            steps=steps,
            batch_size=batch,
            width=width,
            learning_rate=rate,
            seed=seed,
            threads=threads,
            device=device,
        )
        first = mean_model([load_friction(path) for path in start]) if start else None
        settings = settings if first is None else settings.going_on()
        source, learned, judged = training_runs(runs, validation)
        source["start"] = [sha256(path.read_bytes()) for path in start or []]
        source["clips"], rendered = (
            training_clips(clips, learned, judged) if clips else (None, None)
        )
        model = train_friction(
            learned,
            judged,
            settings,
            clips=rendered,
            start=first,
            out=out,
            identity=source,
            resume=resume,
            on_epoch=report_epochs(console, steps),
        )
        model.card.update(source)
        save_friction(out / "friction.safetensors", model)
        write_report(out, model.card)
    console.print(f"{out}: friction.safetensors, report.json, checkpoint.pt", soft_wrap=True)


@cloth.command()
def predict(
    source: Annotated[
        str, typer.Argument(metavar="DATASET_OR_VIDEO", help="a dataset, or a video with --camera")
    ],
    model: Annotated[
        Path | None,
        typer.Option(
            help="friction.safetensors of `cloth train`; that of the package if not given"
        ),
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="train, validation or test; all clips if not given")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="calibrated camera of a video, TOML: see the README of training"),
    ] = None,
    start: Annotated[
        float | None, typer.Option(help="when the holders start in a video [s]; found if not given")
    ] = None,
    frame_rate: Annotated[
        float | None, typer.Option(help="of a video [1/s]; its own times if not given")
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="print a list of {slot, material, mu, familiarity, no_answer}"),
    ] = False,
) -> None:
    """Estimate material and friction, with its 80 % interval, of each clip.

    The clips are those of a dataset, or your own video. A dataset that the weights of the package
    do not know, for example of a coarse mesh, is refused. A clip that is unlike the clips of
    training has no answer, and a reason. If all are so, the exit status is 3.
    """
    from stickslip_training.cloth.evaluation import predictions
    from stickslip_training.cloth.model import WEIGHTS, load_friction
    from stickslip_training.cloth.scope import package_scope

    with readable_errors():
        friction = load_friction(model or WEIGHTS)
        if camera is not None:
            if split is not None:
                raise ValueError(
                    f"--split must not be given with --camera: a video has none, and it is {split}"
                )
            request = _clip_of_video(source, camera, start, frame_rate)
        else:
            for name, value in (("--start", start), ("--frame-rate", frame_rate)):
                if value is not None:
                    raise ValueError(
                        f"{name} must come with --camera: clips of a dataset have times; "
                        f"it is {value:g}"
                    )
            # The card of a model of one's own does not say on which meshes it was trained.
            scope = package_scope(friction.materials) if model is None else None
            request = _clips_of_dataset(source, split, friction, scope)
        posterior = friction.estimate(request.clips)
        answers = predictions(posterior, request.slots, friction.judge(request.clips))
    if as_json:
        typer.echo(json.dumps(answers, indent=1, allow_nan=False))
    else:
        Console().print(_answers(answers, request.truths))
    if all(answer["no_answer"] for answer in answers):
        raise typer.Exit(NO_ANSWER)


@dataclass(frozen=True)
class _Request:
    """Clips to measure."""

    clips: "Clips"
    slots: list[int]
    truths: list[str]
    """Their true values, for the table; empty for a video."""


def _clip_of_video(
    path: str, camera: Path, start: float | None, frame_rate: float | None
) -> _Request:
    """Return the clip of a video, and print its registration."""
    from stickslip_training.cloth.video import import_video, load_camera

    calibration = load_camera(camera)
    clip, registration = import_video(path, calibration, start=start, frame_rate=frame_rate)
    line = (
        f"the video: the holders start at {registration.start:.2f} s, give or take "
        f"{registration.timing:.2f} s; residual {registration.residual:.2f} px"
    )
    Console(stderr=True).print(line, soft_wrap=True)
    return _Request(clip, [0], [])


def _clips_of_dataset(
    source: str, split: str | None, friction: "FrictionModel", scope: "Scope | None"
) -> _Request:
    """Return the clips of a dataset; raise ValueError if it is outside of a scope."""
    from stickslip_schemas.kinds.cloth_drag import ClothDragSpec

    from stickslip_training.cloth.clips import read_clips

    with DatasetReader(source) as reader:
        chosen = cast("Split | None", split)
        if scope is not None and isinstance(reader.spec, ClothDragSpec):
            slots = reader.slots(chosen)
            materials = [reader.categories("material")[c] for c in reader.label("material")[slots]]
            scope.check(
                reader.spec, set(materials), float(reader.label("mu")[slots].max(initial=0))
            )
        clips, slots = read_clips(reader, chosen, friction.materials)
        names = reader.categories("material")
        codes = reader.label("material")[slots].tolist()
    truths = [f"{mu:.2f}, {names[code]}" for code, mu in zip(codes, clips.mu.tolist(), strict=True)]
    return _Request(clips, slots.tolist(), truths)


def _answers(answers: list[dict[str, Any]], truths: list[str]) -> Table:
    """Return a table of answers, with the true values if they are known."""
    table = Table()
    has_truth = bool(truths)
    table.add_column("slot", justify="right")
    table.add_column("material", overflow="fold")
    table.add_column("mu", justify="right")
    table.add_column("80 %", justify="right")
    if has_truth:
        table.add_column("truth", overflow="fold")
    table.add_column("familiarity", justify="right")
    for row, answer in enumerate(answers):
        cells = [str(answer["slot"]), *_estimate_cells(answer)]
        if has_truth:
            cells.append(truths[row])
        table.add_row(*cells, f"{answer['familiarity']:.2f}")
    return table


def _estimate_cells(answer: dict[str, Any]) -> tuple[str, str, str]:
    """Return the likeliest material, the median of mu and its interval, or the reason of none."""
    mu = answer["mu"]
    if mu is None:
        return "", "no answer", answer["no_answer"]
    name, probability = max(answer["material"].items(), key=lambda item: item[1])
    high = f"above {mu['above']:g}" if mu["above"] else f"{mu['high']:.2f}"
    return f"{name} ({probability:.0%})", f"{mu['median']:.2f}", f"{mu['low']:.2f} to {high}"
