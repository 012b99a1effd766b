"""Progress of the simulation that runs in this process."""

_frames: tuple[int, int] | None = None


def tell(done: int, frames: int) -> None:
    """Note that so many frames of a simulation are done."""
    global _frames
    _frames = (done, frames)


def forget() -> None:
    """Note that nothing runs, or that what runs tells nothing."""
    global _frames
    _frames = None


def told() -> tuple[int, int] | None:
    """Return the frames that are done, and the frames; None where nothing runs that tells."""
    return _frames
