"""Tasks of test sets of one kind: questions, and scoring of answers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

from stickslip_training.arrays import Array, Integers
from stickslip_training.data.reader import DatasetReader


class Task(ABC):
    """One for each kind of dataset that has test sets."""

    columns: tuple[str, ...]
    """Of the table of results, besides the method and who entered it."""
    tolerances: Mapping[str, float]
    """By which what `seen` returns may differ between two makings of one set."""

    @abstractmethod
    def labels(self, reader: DatasetReader, slots: Integers) -> list[dict[str, Any]]:
        """Return the labels of slots that follow from the spec: plain values, with equal bits in every making."""

    @abstractmethod
    def seen(self, reader: DatasetReader, slots: Integers) -> dict[str, Array]:
        """Return a little of what a method sees of slots, and of a truth that is computed."""

    @abstractmethod
    def inputs(self, reader: DatasetReader, slots: Integers, secret: bytes) -> dict[str, Array]:
        """Return what a method is given, with noise from a secret; raise ValueError where that is the dataset
        itself."""

    @abstractmethod
    def score(self, reader: DatasetReader, slots: Integers, answers: Sequence[Any]) -> dict[str, Any]:
        """Return the scores of answers as plain values; raise ValueError, which names the answer, where one is none."""

    @abstractmethod
    def row(self, scores: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the cells of `columns`."""

    @abstractmethod
    def rank(self, scores: Mapping[str, Any]) -> float:
        """Return what is smaller for a better entry."""
