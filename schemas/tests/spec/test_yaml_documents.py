"""YAML 1.2: values of plain words, merge keys, and documents that ask for too much."""

import math
import time
from itertools import pairwise
from typing import Any

import pytest
import yaml
from stickslip_schemas.spec import yaml_documents
from stickslip_schemas.spec.yaml_documents import MAX_ALIASED_VALUES, parse_yaml

# The core schema of YAML 1.2.2, section 10.3.2.
VALUES: list[tuple[str, Any]] = [
    (".2e7", 2e6),
    ("2.0e+6", 2e6),
    ("1e-3", 0.001),
    ("1E5", 1e5),
    ("-.5", -0.5),
    ("+12.", 12.0),
    ("1.e3", 1000.0),
    ("010", 10),
    ("0o17", 15),
    ("0x1F", 31),
    ("+12", 12),
    ("-7", -7),
    (".inf", math.inf),
    ("-.INF", -math.inf),
    ("true", True),
    ("FALSE", False),
    ("null", None),
    ("~", None),
    ("", None),
    ("1:30", "1:30"),
    ("1_000", "1_000"),
    ("no", "no"),
    ("on", "on"),
    ("2026-01-01", "2026-01-01"),
    ("0b11", "0b11"),
    (".", "."),
    ("1e", "1e"),
    ("=", "="),
    ("'010'", "010"),
    ('"1e3"', "1e3"),
]


@pytest.mark.parametrize(("text", "value"), VALUES)
def test_plain_words_have_the_values_of_yaml_1_2(text: str, value: Any) -> None:
    parsed = parse_yaml(f"key: {text}")["key"]
    assert parsed == value
    assert type(parsed) is type(value)


def test_nan_is_a_number() -> None:
    assert math.isnan(parse_yaml("key: .NaN")["key"])


def test_merge_keys_add_the_keys_of_other_mappings() -> None:
    text = """
thin: &thin {density: 0.08, young: 2.0e+6}
dark: &dark {color: 1, young: 5}
one: {<<: *thin, density: 0.3}
two:
  <<: [*thin, *dark]
  name: two
"""
    document = parse_yaml(text)
    assert document["one"] == {"density": 0.3, "young": 2e6}
    # The first of several mappings wins.
    assert document["two"] == {"density": 0.08, "young": 2e6, "color": 1, "name": "two"}
    assert document["thin"] == {"density": 0.08, "young": 2e6}


def bomb(value: str) -> str:
    """Return a small document whose aliases of aliases stand for 9^9 values."""
    lines = [f"a: &a {value}"]
    for earlier, name in pairwise("abcdefghij"):
        lines.append(f"{name}: &{name} [{', '.join([f'*{earlier}'] * 9)}]")
    return "\n".join(lines)


def merging_bomb() -> str:
    lines = ["a: &a {k: 1}"]
    for earlier, name in pairwise("abcdefghij"):
        lines.append(f"{name}: &{name} {{<<: [{', '.join([f'*{earlier}'] * 9)}]}}")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: 1\na: 2", "the key 'a' is there twice"),
        ("{1: 2}", "the key 1 is no word"),
        ("? [a]\n: 1", r"the key \['a'\] is no word"),
        ("a: &a {b: *a}", "must not stand inside of its own anchor"),
        ("a: &a [1, [*a]]", "must not stand inside of its own anchor"),
        ("a: {<<: 3}", "for merging"),
        ("a: *absent", "undefined alias"),
        ("a: !!int x", "must be a whole number"),
        ("a: !!float x", "must be a number"),
        ("a: " + "9" * 5000, "must be a whole number of at most 4,300 digits"),
        (
            "a: !!python/object/apply:os.getcwd []",
            "the tag !!python/object/apply:os.getcwd must not be there",
        ),
        ("[" * 200_000, "nested at most 100 deep"),
        ("{a: " * 200_000, "nested at most 100 deep"),
        ("- " * 5_000 + "1", "nested at most 100 deep"),
        (bomb("[1]"), f"aliases must stand for at most {MAX_ALIASED_VALUES} values"),
        (merging_bomb(), f"aliases must stand for at most {MAX_ALIASED_VALUES} values"),
    ],
)
def test_a_document_is_refused_at_once(text: str, problem: str) -> None:
    began = time.process_time()
    with pytest.raises(yaml.YAMLError, match=problem):
        parse_yaml(text)
    assert time.process_time() - began < 2.0


def test_only_aliases_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_documents, "MAX_ALIASED_VALUES", 8)
    assert parse_yaml(f"[{','.join(['1'] * 1000)}]") == [1] * 1000
    # A list of three values is four with itself.
    assert parse_yaml("{a: &a [1, 2, 3], b: *a, c: *a}")["c"] == [1, 2, 3]
    with pytest.raises(yaml.YAMLError, match="aliases must stand for at most 8 values"):
        parse_yaml("{a: &a [1, 2, 3], b: *a, c: *a, d: *a}")
