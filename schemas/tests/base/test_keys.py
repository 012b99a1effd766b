"""Canonical JSON, and keys and seeds made of it."""

import pytest
from stickslip_schemas.base import canonical_json, content_key, derived_seed


def test_canonical_json_is_one_text() -> None:
    assert canonical_json({"b": [1, 2.0, -0.0], "a": "µ"}) == '{"a":"\\u00b5","b":[1,2.0,0.0]}'
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json(float("nan"))


def test_purposes_keep_keys_apart() -> None:
    assert content_key("one", 1) != content_key("two", 1)


def test_seed_zero_is_a_seed() -> None:
    assert derived_seed(0, "color", 1) != derived_seed(1, "color", 1)
    assert derived_seed(0, "color", 1) == derived_seed(0, "color", 1)
