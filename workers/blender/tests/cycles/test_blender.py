"""The device that Cycles computes on: as asked for, or refused; each the same bytes every time."""

import os
import subprocess
import sys
from contextlib import suppress

import pytest
from stickslip_blender import render_context
from stickslip_blender.cycles.engine import (
    CPU,
    DEVICES,
    VARIABLE,
    NoDeviceError,
    described,
    new_scene,
)

_RENDER = """
import hashlib, sys
import numpy as np
from stickslip_blender.cycles.engine import NoDeviceError
from stickslip_blender.scenes.rod_hang import RodRenderer
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.jobs import Quality
line = np.linspace((0.0, 0.0, 0.0), (0.2, 0.1, -0.9), 150)
try:
    renderer = RodRenderer(quality=Quality.preview)
    views = renderer.render(line, load_rig("rod-4"), color=(0.9, 0.5, 0.2))
except NoDeviceError as error:
    print("none:", error)
else:
    print(hashlib.sha256(views.tobytes()).hexdigest(), int(views.max()))
"""


def _rendered(name: str) -> str:
    """Return what a process of its own says that renders with a device."""
    environment = os.environ | {VARIABLE: name}
    done = subprocess.run(
        [sys.executable, "-c", _RENDER],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
        timeout=600,
    )
    return done.stdout.strip().splitlines()[-1]


@pytest.mark.parametrize("name", DEVICES)
def test_two_processes_of_a_device_make_the_same_bytes(name: str) -> None:
    first = _rendered(name)
    if first.startswith("none:"):
        assert name != CPU
        pytest.skip(f"there is no such device: {first}")
    digest, brightest = first.split()
    assert int(brightest) > 60
    assert _rendered(name).split()[0] == digest


@pytest.mark.parametrize("name", DEVICES[1:])
def test_a_device_that_is_not_there_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is rendered on the CPU instead, and no build vouches for it."""
    monkeypatch.setenv(VARIABLE, name)
    with suppress(NoDeviceError):
        described()
        pytest.skip(f"{name} is there")
    with pytest.raises(NoDeviceError, match=f"{VARIABLE} is '{name}'"):
        described()
    with pytest.raises(NoDeviceError):
        new_scene()
    with pytest.raises(NoDeviceError):
        render_context.build_digest.__wrapped__("rod_hang")


def test_an_unknown_device_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "tpu")
    with pytest.raises(
        NoDeviceError, match=r"STICKSLIP_RENDER_DEVICE must be one of cpu, optix.*; got 'tpu'"
    ):
        new_scene()


def test_device_names_and_driver_are_in_every_build(monkeypatch: pytest.MonkeyPatch) -> None:
    digest = render_context.build_digest.__wrapped__
    digests = {digest("rod_hang")}
    for driver, names in (("550", ["one"]), ("570", ["one"]), ("570", ["another"])):
        gpu = {"device": "optix", "names": names, "driver": driver}
        monkeypatch.setattr(render_context, "described", lambda gpu=gpu: gpu)
        digests.add(digest("rod_hang"))
    assert len(digests) == 4


def test_a_scene_without_a_wish_is_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert described() == {"device": "cpu"}
    assert new_scene().cycles.device == "CPU"
