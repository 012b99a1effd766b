"""Facts about real things: complete, and the same in the documentation."""

from pathlib import Path

from stickslip_schemas.spec.names import Material
from stickslip_schemas.spec.reality import measured_fabrics, reality

LABELS = Path(__file__).parents[3] / "docs/labels.md"


def test_every_built_in_fabric_states_bending_length_and_drape() -> None:
    fabrics = measured_fabrics()
    assert set(fabrics) == set(Material)
    for facts in fabrics.values():
        assert all(10.0 < length < 40.0 for length in facts.bending_length)
        # Half of an unbent ring would be 100 %.
        assert 20.0 < facts.drape < 95.0
        assert 3 <= facts.folds <= 14


def test_stiffer_fabrics_drape_less() -> None:
    fabrics = measured_fabrics()
    by_stiffness = sorted(fabrics, key=lambda name: sum(fabrics[name].bending_length))
    assert fabrics[by_stiffness[0]].drape < 45.0
    assert fabrics[by_stiffness[-1]].drape > 70.0


def test_the_page_of_labels_names_all_that_the_model_of_cloth_leaves_out() -> None:
    page = LABELS.read_text(encoding="utf-8")
    for item in reality().missing_of("cloth"):
        assert f"| {item.missing} |" in page


def test_bands_have_an_order_and_a_source() -> None:
    for band in reality().bands:
        assert 0.0 < band.low < band.high < 100.0
        assert band.source
