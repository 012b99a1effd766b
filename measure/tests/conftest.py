"""Fixtures of the measurement's tests."""

from collections.abc import Callable
from pathlib import Path

import pytest
from stickslip_measure.process import Program

FALLING = """
import os, signal, time
import numpy as np

class Simulator:
    name = "falling"
    version = "1"
    capabilities = {"floor", "held"}
    settings = {"default": {"step": "10 ms"}}
    frame = 0.01

    def __init__(self, scene, setting):
        START
        self.x = scene.start.copy()
        self.v = np.zeros_like(self.x)
        self.gravity = np.array(scene.gravity)
        self.time = 0.0

    def step(self):
        STEP
        self.time += self.frame
        self.v += self.gravity * self.frame
        self.x += self.v * self.frame

    def positions(self):
        return self.x

    def set_gravity(self, gravity):
        self.gravity = gravity
"""
"""A patch that falls through everything, since it knows neither bodies nor held vertices."""


@pytest.fixture
def falling_text() -> str:
    """The adapter of a patch that falls."""
    return FALLING.replace("STEP", "pass").replace("START", "pass")


@pytest.fixture
def written(tmp_path: Path) -> Callable[[str], Program]:
    """Write an adapter into a file, and return how to run it."""

    def write(text: str) -> Program:
        path = tmp_path / "adapter.py"
        path.write_text(text)
        return Program(path)

    return write


@pytest.fixture
def falling(written: Callable[[str], Program]) -> Callable[..., Program]:
    """Write the patch that falls, with other statements or other lines."""

    def write(step: str = "pass", start: str = "pass", **lines: str) -> Program:
        text = FALLING.replace("STEP", step).replace("START", start)
        for name, value in lines.items():
            text = text.replace(f"    {name} = ", f"    {name} = {value}  # not ")
        return written(text)

    return write
