"""The commands `stickslip-train cloth ...`: friction and material of dragged cloth from video."""

import json
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from rich.console import Console
from rich.table import Table

from stickslip_training.cli.commands import readable_errors, shows_epochs
from stickslip_training.data.reader import DatasetReader, Split

NO_ANSWER = 3
"""Exit status of `predict` where no clip has an answer."""

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
            help="train on these clips of Blender, too: a dataset, or files of blender_clips.py (.npz)"
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
    """Train a network that estimates material and friction, on pictures rendered from simulations
    while it trains.
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
            on_epoch=shows_epochs(console, steps),
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
    """Estimate material and friction, with its 80 % interval, of each clip of a dataset or of your
    own video.

    A clip that is unlike those of training has no answer, and a reason; if all are so, the exit
    status is 3.
    """
    from stickslip_training.cloth.clips import read_clips
    from stickslip_training.cloth.evaluation import predictions
    from stickslip_training.cloth.model import WEIGHTS, load_friction
    from stickslip_training.cloth.video import import_video, load_camera

    with readable_errors():
        friction = load_friction(model or WEIGHTS)
        true: list[str] = []
        if camera is not None:
            if split is not None:
                raise ValueError(
                    f"split must not be given with camera: a video has none, and it is {split!r}"
                )
            calibration = load_camera(camera)
            clips, found_in = import_video(source, calibration, start=start, frame_rate=frame_rate)
            Console(stderr=True).print(f"the video: {found_in}", soft_wrap=True)
            slots = [0]
        else:
            for name, value in (("start", start), ("frame_rate", frame_rate)):
                if value is not None:
                    raise ValueError(
                        f"{name} must come with --camera: clips of a dataset have times; it is {value}"
                    )
            with DatasetReader(source) as reader:
                clips, found = read_clips(reader, cast("Split | None", split), friction.materials)
                names = reader.categories("material")
                fabrics = [names[code] for code in reader.label("material")[found].tolist()]
            slots = found.tolist()
            true = [
                f"{mu:.2f}, {fabric}" for fabric, mu in zip(fabrics, clips.mu.tolist(), strict=True)
            ]
        answers = predictions(friction.estimate(clips), slots, friction.judge(clips))
    if as_json:
        typer.echo(json.dumps(answers, indent=1))
    else:
        Console().print(_answers(answers, true))
    if all(answer["no_answer"] for answer in answers):
        raise typer.Exit(NO_ANSWER)


def _answers(answers: list[dict[str, Any]], true: list[str]) -> Table:
    table = Table()
    for title in ("slot", "material", "mu", "80 %", *(["truth"] if true else []), "familiarity"):
        table.add_column(title, justify="left" if title in ("material", "truth") else "right")
    for place, answer in enumerate(answers):
        name, probability = max(answer["material"].items(), key=lambda item: item[1])
        mu = answer["mu"]
        if mu is None:
            cells = ["", "no answer", answer["no_answer"]]
        else:
            bounds = f"{mu['low']:.2f} to " + (
                f"above {mu['above']:g}" if mu["above"] else f"{mu['high']:.2f}"
            )
            cells = [f"{name} ({probability:.0%})", f"{mu['median']:.2f}", bounds]
        table.add_row(
            str(answer["slot"]), *cells, *true[place : place + 1], f"{answer['familiarity']:.2f}"
        )
    return table
