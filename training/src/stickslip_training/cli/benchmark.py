"""The commands `stickslip-train benchmark ...`: named test sets that are open to all."""

import json
from pathlib import Path
from secrets import token_bytes
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from stickslip_schemas.store import write_durably

from stickslip_training.cli.shared import DatasetArgument, readable_errors
from stickslip_training.data.reader import DatasetReader

benchmark = typer.Typer(no_args_is_help=True, help="Named test sets: enter yours, and compare.")

SetArgument = Annotated[
    str, typer.Argument(metavar="SET", help="name of a test set: see `benchmark list`")
]


@benchmark.command("list")
def list_() -> None:
    """Say which test sets there are."""
    from stickslip_training.benchmark.clip_sets import clip_set_names, load_clip_set
    from stickslip_training.benchmark.sets import load_set, set_names

    listed = Table(box=None, header_style="bold")
    for title in ("set", "kind", "to answer"):
        listed.add_column(title)
    for name in set_names():
        chosen = load_set(name)
        listed.add_row(name, str(chosen.parsed_spec.kind), chosen.about)
    for name in clip_set_names():
        listed.add_row(name, "clips", load_clip_set(name).about)
    Console().print(listed)


@benchmark.command()
def spec(name: SetArgument) -> None:
    """Print the spec of a test set, for `stickslip submit`."""
    from stickslip_training.benchmark.sets import load_set

    with readable_errors():
        typer.echo(json.dumps(load_set(name).spec, indent=2))


@benchmark.command()
def check(name: SetArgument, dataset: DatasetArgument) -> None:
    """Say whether a dataset is the test set, and which making of it."""
    from stickslip_training.benchmark.clip_sets import clip_set_names, load_clip_set
    from stickslip_training.benchmark.sets import load_set

    with readable_errors():
        if name in clip_set_names():
            clip_set = load_clip_set(name)
            clip_set.check(Path(dataset))
            typer.echo(f"{dataset} is {name}: {clip_set.clips} clips to answer")
            return
        with DatasetReader(dataset) as reader:
            slots, making = load_set(name).check(reader)
    typer.echo(f"{dataset} is {name}, {making}: {len(slots)} samples to answer")


@benchmark.command()
def inputs(
    name: SetArgument,
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="file for what a method is given (.npz)")],
    secret: Annotated[
        Path,
        typer.Option(
            help=(
                "file that the noise is drawn from; the scorer keeps it, and the first "
                "call makes it"
            )
        ),
    ],
) -> None:
    """Write the input of a method, if it is not the dataset itself: rods get noise."""
    import numpy as np

    from stickslip_training.benchmark.sets import load_set

    with readable_errors(), DatasetReader(dataset) as reader:
        chosen = load_set(name)
        slots = chosen.check(reader)[0]
        if not secret.exists():
            write_durably(secret, token_bytes(32))
        inputs = chosen.task.inputs(reader, slots, secret.read_bytes())
        with out.open("wb") as file:
            np.savez(file, **inputs)  # type: ignore[arg-type]  # its stub takes no dictionary
    shapes = ", ".join(f"{key} {values.shape}" for key, values in inputs.items())
    typer.echo(f"{out}: {shapes}")


@benchmark.command()
def score(
    name: SetArgument,
    predictions: Annotated[
        Path, typer.Argument(metavar="PREDICTIONS", help="your answers, a JSON list")
    ],
    dataset: DatasetArgument,
    method: Annotated[str, typer.Option(help="its name in the table")] = "yours",
    by: Annotated[str, typer.Option(help="who entered it")] = "you",
    trained_on: Annotated[str, typer.Option(help="data that the method learnt from")] = "not said",
    link: Annotated[str | None, typer.Option(help="to code, or a text about the method")] = None,
    record: Annotated[
        Path | None, typer.Option(help="file for the record of this entry (.json)")
    ] = None,
) -> None:
    """Score a file of predictions on a test set; the dataset is compared with the set first."""
    from stickslip_training.benchmark.sets import enter, table

    with readable_errors():
        entry = enter(
            name, predictions, dataset, method=method, by=by, trained_on=trained_on, link=link
        )
        if record is not None:
            record.parent.mkdir(parents=True, exist_ok=True)
            write_durably(record, entry.document())
        typer.echo(table(name, [entry]))


@benchmark.command("table")
def table_(
    records: Annotated[
        list[Path],
        typer.Argument(metavar="RECORD...", help="what `benchmark score --record` wrote"),
    ],
    page: Annotated[
        Path | None, typer.Option(help="put the tables into this page, between its marks")
    ] = None,
) -> None:
    """Print the tables of records, best first, or put them into a page."""
    from stickslip_training.benchmark.sets import read_record, table, with_tables

    with readable_errors():
        read = [read_record(path) for path in records]
        if page is not None:
            write_durably(page, with_tables(page.read_text(encoding="utf-8"), read).encode())
            return
        for name in sorted({record.set for record in read}):
            typer.echo(f"{name}\n\n{table(name, read)}\n")
