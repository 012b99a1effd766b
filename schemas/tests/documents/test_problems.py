"""Wrong values in messages: their beginning, whatever their size."""

import time
from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.base import Document
from stickslip_schemas.documents.problems import field_errors


class Counted(Document):
    """A document with a number."""

    count: int


def problem_of(value: Any) -> str:
    document = {"count": value}
    with pytest.raises(ValidationError) as caught:
        Counted.model_validate(document)
    (error,) = field_errors(caught.value, document, Counted)
    return str(error.value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("x", '"x"'),
        ([1, [2, {"a": None}]], '[1, [2, {"a": null}]]'),
        ({"a": [], "b": {}}, '{"a": [], "b": {}}'),
        ("x" * 300, '"' + "x" * 196 + "..."),
        ([7] * 1000, "[" + "7, " * 65 + "7..."),
    ],
)
def test_the_beginning_of_a_value_is_shown(value: Any, text: str) -> None:
    assert problem_of(value) == text


def test_a_value_of_millions_is_not_written_out() -> None:
    values = [[1.5] * 10 for _ in range(300_000)]
    begin = time.process_time()
    assert problem_of(values).startswith("[[1.5, 1.5, ")
    assert time.process_time() - begin < 0.2
