"""The build digest is over what is rendered with, and nothing else."""

import pytest
from stickslip_blender import build
from stickslip_blender.build import CUT, build_digest, roots
from stickslip_schemas.sources import sources


def test_the_rasteriser_is_in_the_build_of_cloth_and_not_of_rods(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {kind: build_digest(kind) for kind in ("cloth_drag", "rod_hang")}
    monkeypatch.setattr(build, "BUILD_HASH", "another")
    assert build_digest("cloth_drag") != before["cloth_drag"]
    assert build_digest("rod_hang") == before["rod_hang"]


def test_data_files_are_in_the_build() -> None:
    files = sources(roots("cloth_drag"), cut=CUT)
    assert {"stickslip_blender/fabrics.toml", "stickslip_blender/substrates.toml"} <= set(files)
