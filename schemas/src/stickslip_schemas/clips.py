"""Which instants a cloth trajectory has, and which of them a clip shows."""

FRAMES = 300
"""Frames of a drop-and-drag trajectory [thesis, 4.2.4]."""

FRAMES_PER_SECOND = 2.4


def shown_frames(count: int) -> tuple[int, ...]:
    """Return the frames of the trajectory that a clip of `count` frames shows: the first, and then evenly spread."""
    if not 1 <= count <= FRAMES:
        raise ValueError(f"frames must be from 1 to {FRAMES}, and is {count}")
    return tuple(position * FRAMES // count for position in range(count))
