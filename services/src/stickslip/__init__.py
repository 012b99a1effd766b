"""The client of a coordinator of stickslip: `Client`, `pull`, `verify` and their errors."""

from stickslip_services.client import *  # noqa: F403
from stickslip_services.client import __all__ as __all__
