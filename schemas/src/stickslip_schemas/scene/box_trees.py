"""Trees of boxes: which boxes of one set overlap boxes of another set.

The cost grows with the number of boxes and of overlaps, not with the product of both sets.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

CANDIDATES_AT_ONCE = 100_000
"""Candidates that are compared in one operation: bounds the memory to about 100 MB."""

MORTON_BITS = 10
"""Bits of each coordinate of a Morton code: boxes that are neighbours in it are near each other."""

MAX_COMPARED_PAIRS = 10_000_000
"""Pairs of boxes, on all levels of trees, that a `Workload` allows: a second of CPU time.

A sheet of 100,000 vertices, rolled up with half a cell between its layers, has 9 million."""


class TooManyPairsError(Exception):
    """More boxes overlap than a workload allows."""


class Workload:
    """The work that several searches may do together."""

    def __init__(self, pairs: int) -> None:
        """Allow so many comparisons of two boxes."""
        self._pairs_left = pairs

    def add(self, pairs: int) -> None:
        """Count comparisons; raise TooManyPairsError if no more are allowed."""
        self._pairs_left -= pairs
        if self._pairs_left < 0:
            raise TooManyPairsError


class BoxTree:
    """A binary tree of boxes, level by level, whose leaves are given boxes."""

    def __init__(self, low: Floats, high: Floats) -> None:
        """Build the tree over N boxes with corners `low` and `high`, (N, 3) [m] each."""
        count = len(low)
        self.depth = max(count - 1, 0).bit_length()
        self.order = np.argsort(_morton_codes(0.5 * (low + high)), kind="stable")
        # Coordinates are rows, for minima of columns take ten times as long. Leaves without a box
        # are empty: they overlap nothing.
        leaves = 2**self.depth
        lowest = np.full((3, leaves), np.inf)
        highest = np.full((3, leaves), -np.inf)
        lowest[:, :count] = low[self.order].T
        highest[:, :count] = high[self.order].T
        self.levels = [(lowest, highest)]
        for _ in range(self.depth):
            lowest = np.minimum(lowest[:, ::2], lowest[:, 1::2])
            highest = np.maximum(highest[:, ::2], highest[:, 1::2])
            self.levels.append((lowest, highest))
        self.levels.reverse()


def _spread_bits() -> Integers:
    """Return the numbers of `MORTON_BITS` bits with two zeros before each bit."""
    numbers = np.arange(2**MORTON_BITS, dtype=np.int64)
    spread = np.zeros_like(numbers)
    for bit in range(MORTON_BITS):
        spread |= ((numbers >> bit) & 1) << (3 * bit)
    return spread


_SPREAD_BITS = _spread_bits()


def _morton_codes(points: Floats) -> Integers:
    """Return codes (N,) in whose order points (N, 3) [m] follow a space-filling curve."""
    low = points.min(axis=0)
    extent = max(float((points.max(axis=0) - low).max()), 1e-300)
    cells = ((points - low) / extent * (2**MORTON_BITS - 1)).astype(np.int64)
    spread = _SPREAD_BITS[cells]
    return np.asarray(spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2)


def overlapping_boxes(
    first: BoxTree, second: BoxTree, workload: Workload, *, reach: float = 0.0
) -> Iterator[tuple[Integers, Integers]]:
    """Yield the pairs of boxes that overlap, as numbers of boxes, in batches.

    Boxes that are nearer to each second than `reach` [m] along each axis count as overlapping. If a
    tree is compared with itself, each pair comes once.

    Raises:
        TooManyPairsError: The workload ends.
    """
    is_same = first is second
    start = (np.zeros(1, np.int64), np.zeros(1, np.int64), 0, 0)
    waiting = [start]
    while waiting:
        i, j, level_first, level_second = waiting.pop()
        workload.add(len(i))
        i, j = _overlapping(i, j, first.levels[level_first], second.levels[level_second], reach)
        if not len(i):
            continue
        if level_first == first.depth and level_second == second.depth:
            yield first.order[i], second.order[j]
            continue
        # Both trees are descended by one level, as long as they have another.
        if level_first < first.depth:
            i, j = np.repeat(2 * i, 2) + np.tile([0, 1], len(i)), np.repeat(j, 2)
            level_first += 1
        if level_second < second.depth:
            j, i = np.repeat(2 * j, 2) + np.tile([0, 1], len(j)), np.repeat(i, 2)
            level_second += 1
        if is_same:
            is_first = i <= j
            i, j = i[is_first], j[is_first]
        for begin in range(0, len(i), CANDIDATES_AT_ONCE):
            end = begin + CANDIDATES_AT_ONCE
            waiting.append((i[begin:end], j[begin:end], level_first, level_second))


def _overlapping(
    i: Integers,
    j: Integers,
    first: tuple[Floats, Floats],
    second: tuple[Floats, Floats],
    reach: float,
) -> tuple[Integers, Integers]:
    """Return the pairs of nodes i and j whose boxes overlap, of a level of each tree."""
    # Each coordinate leaves fewer pairs to the next one.
    for low_first, high_first, low_second, high_second in zip(*first, *second, strict=True):
        overlaps = low_first[i] <= high_second[j] + reach
        overlaps &= low_second[j] <= high_first[i] + reach
        i, j = i[overlaps], j[overlaps]
    return i, j
