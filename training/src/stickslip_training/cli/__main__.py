"""`python -m stickslip_training.cli`."""

from stickslip_training.cli import app

app(prog_name="stickslip-train")
