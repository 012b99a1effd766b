"""The coordinator of stickslip with its durable queue, the HTTP client and the command line."""

from importlib.metadata import version

__version__ = version("stickslip")
