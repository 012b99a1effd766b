"""Measure the friction and bending of any simulator. docs/yardstick.md is the guide."""

from importlib.metadata import version

__version__ = version("stickslip-measure")
