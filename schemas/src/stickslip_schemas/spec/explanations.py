"""Errors of pydantic in the words of people who write specs."""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pydantic_core import ErrorDetails

from stickslip_schemas.base import literals, models_at, unit_of
from stickslip_schemas.spec.names import did_you_mean

PATTERN_RULES = {
    r"^[a-z0-9][a-z0-9-]{0,62}$": (
        "must be lower-case letters, digits and '-', 63 at most, the first one no '-'"
    ),
    r"^[a-z0-9][a-z0-9-]*$": "must be lower-case letters, digits and '-', the first one no '-'",
    r"^[a-z][a-z0-9_]{0,62}$": (
        "must be lower-case letters, digits and '_', 63 at most, a letter first"
    ),
    r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$": (
        "must be letters, digits, '_', '.' and '-', 63 at most, a letter or digit first"
    ),
    r"^[A-Za-z0-9_][A-Za-z0-9_./-]*$": (
        "must be a path of letters, digits, '_', '.', '-' and '/', a letter, digit or '_' first"
    ),
    r"^sha256:[0-9a-f]{64}$": "must be `sha256:` and 64 lower-case hexadecimal digits",
    r"^[0-9a-f]{64}$": "must be 64 lower-case hexadecimal digits",
}
"""The rule of each pattern of our documents, in words: nobody has to read an expression."""


_OTHER_UNITS: Mapping[str, tuple[str, float]] = {
    "m": ("mm", 1e-3),
    "rad": ("degrees", math.pi / 180),
}
"""The unit that people write instead of ours, and the factor between both."""


class Explanation(NamedTuple):
    """An error of pydantic in words."""

    rule: str
    """The rule that does not hold, with its unit."""
    location: tuple[int | str, ...]
    """The location, with parts that only pydantic knows."""
    value: Any
    is_missing: bool = False
    """True if there is no value to show."""


def explain(item: ErrorDetails, expected: Any) -> Explanation:
    """Return an error of pydantic in words.

    `expected` is the type of the document, a model or a union of models. Misspelt words are
    compared with its fields and values.
    """
    explanation = _EXPLANATIONS.get(item["type"], _explain_other)(item, expected)
    unit = unit_of(item, expected)
    hint = _other_unit_hint(item, unit.strip(" []"))
    return explanation._replace(rule=explanation.rule + unit + hint)


def _other_unit_hint(item: ErrorDetails, unit: str) -> str:
    """Return a question for another unit, in which a number beyond a limit would be within it."""
    limit = item.get("ctx", {}).get(
        {"less_than_equal": "le", "greater_than_equal": "ge"}.get(item["type"], "")
    )
    value = item["input"]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if limit is None or not is_number or unit not in _OTHER_UNITS:
        return ""
    other, factor = _OTHER_UNITS[unit]
    converted = factor * value
    # A length that is too small is not one in millimetres.
    if abs(value) < abs(limit) or abs(converted) > abs(limit):
        return ""
    return f"; did you mean {other}? {value:g} {other} are {converted:.6g} {unit}"


_Explain = Callable[[ErrorDetails, Any], Explanation]


def _explain_other(item: ErrorDetails, _expected: Any) -> Explanation:
    # pydantic puts the first before the messages of our own checks, and begins its own with the
    # second.
    rule = item["msg"].removeprefix("Value error, ")
    if rule.startswith("Input should be "):
        rule = "must be " + rule.removeprefix("Input should be ")
    return Explanation(rule, item["loc"], item["input"])


def _explain_missing(item: ErrorDetails, _expected: Any) -> Explanation:
    return Explanation("this field is required", item["loc"], None, is_missing=True)


def _explain_extra(item: ErrorDetails, expected: Any) -> Explanation:
    location = item["loc"]
    known: set[str] = set()
    for model in models_at(expected, location[:-1]):
        known.update(model.model_fields)
    hint = did_you_mean(str(location[-1]), sorted(known)) or "."
    rule = f"there is no such field{hint} Fields: {', '.join(sorted(known))}"
    return Explanation(rule, location, item["input"])


def _explain_tag(item: ErrorDetails, expected: Any) -> Explanation:
    """Explain that the field that selects a model of a union is missing or unknown."""
    location = item["loc"]
    value = item["input"]
    tag = item["ctx"]["discriminator"].strip("'")
    known: list[str] = []
    for model in models_at(expected, location):
        if tag in model.model_fields:
            known += literals(model.model_fields[tag].annotation)
    listed = ", ".join(known)
    if not isinstance(value, Mapping):
        return Explanation(
            f"must be an object with the field {tag}, one of {listed}", location, value
        )
    word = value.get(tag)
    hint = did_you_mean(word, known) if isinstance(word, str) else ""
    is_missing = item["type"] == "union_tag_not_found"
    return Explanation(f"must be one of {listed}{hint}", (*location, tag), word, is_missing)


def _explain_object(item: ErrorDetails, _expected: Any) -> Explanation:
    rule = "must be an object"
    if item["loc"][-2:-1] == ("axes",):
        rule = "must be a value, a list of values, or an object with the field type"
    return Explanation(rule, item["loc"], item["input"])


def _explain_list(item: ErrorDetails, _expected: Any) -> Explanation:
    return Explanation("must be a list", item["loc"], item["input"])


def _explain_length(item: ErrorDetails, _expected: Any) -> Explanation:
    rule = f"must have at least {item['ctx']['min_length']} item(s)"
    return Explanation(rule, item["loc"], item["input"])


def _explain_choice(item: ErrorDetails, _expected: Any) -> Explanation:
    value = item["input"]
    known = re.findall(r"'([^']*)'", item["ctx"]["expected"])
    hint = did_you_mean(value, known) if isinstance(value, str) else ""
    return Explanation(f"must be one of {', '.join(known)}{hint}", item["loc"], value)


def _explain_pattern(item: ErrorDetails, _expected: Any) -> Explanation:
    pattern = item["ctx"]["pattern"]
    rule = PATTERN_RULES.get(pattern, f"must have the form {pattern}")
    # pydantic marks the key of a mapping, as opposed to its value, by a part of the location.
    location = item["loc"]
    if location and location[-1] == "[key]":
        location = location[:-1]
        rule = f"its name {rule}"
    return Explanation(rule, location, item["input"])


_EXPLANATIONS: Mapping[str, _Explain] = {
    "missing": _explain_missing,
    "extra_forbidden": _explain_extra,
    "union_tag_invalid": _explain_tag,
    "union_tag_not_found": _explain_tag,
    "model_type": _explain_object,
    "model_attributes_type": _explain_object,
    "dict_type": _explain_object,
    "tuple_type": _explain_list,
    "list_type": _explain_list,
    "too_short": _explain_length,
    "enum": _explain_choice,
    "literal_error": _explain_choice,
    "string_pattern_mismatch": _explain_pattern,
}
"""How errors of pydantic are explained, by their type."""
