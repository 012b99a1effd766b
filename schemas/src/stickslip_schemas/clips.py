"""Which instants of a trajectory a clip shows."""


def shown_frames(count: int, instants: int) -> tuple[int, ...]:
    """Return the instants that a clip of `count` frames shows of `instants`: the first, and then evenly spread."""
    if not 1 <= count <= instants:
        raise ValueError(f"frames must be from 1 to {instants}, and is {count}")
    return tuple(position * instants // count for position in range(count))
