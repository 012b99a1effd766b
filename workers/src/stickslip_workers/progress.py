"""Progress of the simulation that runs in this process."""

_frames: tuple[int, int] | None = None


def note(done: int, frames: int) -> None:
    """Set the progress of the simulation: frames done, frames total."""
    global _frames
    _frames = (done, frames)


def clear() -> None:
    """Forget the progress, before and after a simulation."""
    global _frames
    _frames = None


def current() -> tuple[int, int] | None:
    """Return (frames done, frames total), or None if no simulation reports progress."""
    return _frames
