"""The work of the stages, as functions from a task and a store to an output.

The functions use no coordinator and start no Ray calls.
"""
