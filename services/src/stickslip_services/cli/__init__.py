"""The command line `stickslip`."""

from stickslip_services.cli.main import app

__all__ = ["app"]
