"""`python -m stickslip_services.cli`."""

from stickslip_services.cli import app

app()
