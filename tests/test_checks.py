"""The table of checks is the same in the solver, the datasets, the reasons of rejections, and the
docs.
"""

from pathlib import Path

from stickslip_schemas.base import Reason
from stickslip_schemas.kinds.cloth.arrays import CHECKS as LABELS
from stickslip_sim_core.cloth.checks import CHECKS

DOCS = Path(__file__).parents[1] / "docs" / "cloth.md"


def test_labels_are_the_checks() -> None:
    assert {name: limit for name, (_, limit) in LABELS.items()} == {
        check.name: check.limit for check in CHECKS
    }


def test_a_check_that_judges_is_a_reason_that_no_second_try_mends() -> None:
    assert all(Reason(check.name).is_deterministic for check in CHECKS if check.limit is not None)


def test_docs_have_the_table() -> None:
    text = DOCS.read_text()
    for check in CHECKS:
        limit = "recorded" if check.limit is None else f"{check.limit:g}"
        assert f"| `{check.name}` | {check.formula} | {check.unit} | {limit} |" in text, check.name
