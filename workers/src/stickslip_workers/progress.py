"""Progress of the simulation that runs in this process."""

frames: tuple[int, int] | None = None
"""Frames done and frames in all; None if no simulation reports progress."""


def note(done: int, total: int) -> None:
    """Set the progress of the simulation."""
    global frames
    frames = done, total
