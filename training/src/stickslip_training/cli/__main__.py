"""`python -m stickslip_training.cli`."""

from stickslip_training.cli import app

if __name__ == "__main__":
    app(prog_name="stickslip-train")
