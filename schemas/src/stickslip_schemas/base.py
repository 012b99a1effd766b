"""The base of every document that crosses a process boundary."""

from pydantic import BaseModel, ConfigDict


class Document(BaseModel):
    """Refuse unknown fields, NaN and infinities; never change after construction."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
