"""The command `stickslip-train`: one file for each noun, and one for commands without."""

import typer

from stickslip_training.cli.benchmark import benchmark
from stickslip_training.cli.cloth import cloth
from stickslip_training.cli.datasets import export, info
from stickslip_training.cli.film import film
from stickslip_training.cli.rods import curvature, reconstruct

app = typer.Typer(
    no_args_is_help=True, add_completion=False, help="Read stickslip datasets and train on them."
)
app.command()(info)
app.command()(export)
app.command()(curvature)
app.command()(reconstruct)
app.add_typer(cloth, name="cloth")
app.add_typer(film, name="film")
app.add_typer(benchmark, name="benchmark")
