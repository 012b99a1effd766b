"""`python -m stickslip_services.cli`."""

from stickslip_services.cli.main import app

app()
