"""The build digest covers the files of the renderer only."""

import pytest
from stickslip_blender import render_context
from stickslip_blender.actor import renders
from stickslip_blender.render_context import build_digest, roots
from stickslip_schemas.kinds import KINDS, UnknownKindError
from stickslip_schemas.plan.builds import UNCOUNTED, sources


def test_the_rasteriser_is_in_every_build(monkeypatch: pytest.MonkeyPatch) -> None:
    digest = build_digest.__wrapped__  # not the one that is kept
    before = {kind: digest(kind) for kind in KINDS}
    monkeypatch.setattr(render_context, "BUILD_HASH", "another")
    assert all(digest(kind) != before[kind] for kind in KINDS)


def test_data_files_are_in_the_build() -> None:
    files = sources(roots("cloth_drag"), cut=UNCOUNTED)
    assert {
        "stickslip_blender/cloth/fabrics.toml",
        "stickslip_blender/cloth/substrates.toml",
    } <= set(files)


def test_every_kind_has_a_build_of_its_own_files() -> None:
    assert len({build_digest(kind) for kind in KINDS}) == len(KINDS)
    for kind in KINDS:
        scenes = {name for name in sources(roots(kind), cut=UNCOUNTED) if "/scenes/" in name}
        assert scenes == {f"stickslip_blender/scenes/{kind}.py"}


def test_a_kind_that_nobody_registered_is_refused() -> None:
    with pytest.raises(UnknownKindError, match=r"kind must be one of .*; got 'silk_fly'"):
        renders("silk_fly")
