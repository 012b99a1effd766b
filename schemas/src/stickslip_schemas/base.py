"""The base of every document that crosses a process boundary, and numbers that are not read out of other types."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Strict

Int = Annotated[int, Strict()]
"""A whole number: not the text "1", not 1.0, not true."""
Float = Annotated[float, Strict()]
"""A number: not the text "1", not true."""
Bool = Annotated[bool, Strict()]
"""True or false: not 1, not "yes"."""


class Document(BaseModel):
    """Refuse unknown fields, NaN and infinities; never change after construction."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
