"""Runs tasks: the dispatcher, which is a Ray driver, and the stages, which are functions.

See the modules.
"""
