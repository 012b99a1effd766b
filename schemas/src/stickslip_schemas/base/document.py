"""The base of every document that crosses a process boundary, and numbers that are not read out of other types."""

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Strict


def _whole(value: Any) -> Any:
    """Return 1 for 1.0, which is the same number in JSON."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


WHOLE = BeforeValidator(_whole)
"""For integers with bounds of their own: stands after them, or the bounds are not in the JSON schema."""
Int = Annotated[int, Strict(), WHOLE]
"""A whole number: not the text "1", not true."""
Float = Annotated[float, Strict()]
"""A number: not the text "1", not true."""
Bool = Annotated[bool, Strict()]
"""True or false: not 1, not "yes"."""


class Document(BaseModel):
    """Refuse unknown fields, NaN and infinities; never change after construction."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
