"""The coordinator of stickslip with its durable queue, the HTTP client and the command line."""

__version__ = "0.1.0"
