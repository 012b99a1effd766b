"""Runs tasks: the dispatcher, which is a Ray driver, and the stages, which are functions. See the modules."""

__version__ = "0.1.0"
