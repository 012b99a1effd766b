"""Messages between the measurement and the process of an adapter: a JSON header and raw arrays.

    length of the header (4 bytes, big end first), header, bytes of the arrays one after the other

The header says the type and the shape of each array. Only the standard library and NumPy are
imported: the module also runs in the environment of the measured simulator.
"""

from __future__ import annotations  # Python 3.9 reads the types below as text

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Message = tuple[dict[str, Any], list[Array]]

_LENGTH = struct.Struct(">I")
_TYPES = ("<f8", "<i4", "<i8")


def encoded(header: dict[str, Any], arrays: Sequence[Array] = ()) -> bytes:
    """Return the bytes of a message."""
    parts = [np.ascontiguousarray(array) for array in arrays]
    kinds = [(part.dtype.newbyteorder("<").str, list(part.shape)) for part in parts]
    text = json.dumps({**header, "arrays": kinds}).encode()
    return b"".join([_LENGTH.pack(len(text)), text, *(part.tobytes() for part in parts)])


def read_message(read: Callable[[int], bytes]) -> Message:
    """Read a message with a function that returns exactly the number of bytes that it is asked.

    Raises:
        ValueError: The bytes are no message.
    """
    (length,) = _LENGTH.unpack(read(_LENGTH.size))
    header = json.loads(read(length))
    arrays = []
    for name, shape in header.pop("arrays"):
        # Only these types are sent, so anything else is a damaged stream.
        if name not in _TYPES:
            raise ValueError(f"type of an array: must be one of {', '.join(_TYPES)}, got {name}")
        dtype = np.dtype(name)
        content = read(dtype.itemsize * int(np.prod(shape)))
        arrays.append(np.frombuffer(content, dtype).reshape(shape).copy())
    return header, arrays


def from_scene(scene: Any) -> Message:
    """Return a scene of the contract as a header and arrays."""
    values: dict[str, Any] = {}
    arrays: list[Array] = []
    for item in fields(scene):
        value = getattr(scene, item.name)
        if isinstance(value, np.ndarray):
            # The header keeps the place of the array in the list.
            values[item.name] = {"array": len(arrays)}
            arrays.append(value)
        elif item.name == "bodies":
            values[item.name] = [vars(body) for body in value]
        else:
            values[item.name] = value
    return {"kind": type(scene).__name__, "values": values}, arrays


def to_scene(message: Message, contract: Any) -> Any:
    """Return the scene of a message; `contract` is the module with its class."""
    header, arrays = message
    values = {}
    for name, value in header["values"].items():
        values[name] = value
        if isinstance(value, dict):
            values[name] = arrays[value["array"]]
        elif name == "bodies":
            values[name] = tuple(_body(contract, body) for body in value)
        elif isinstance(value, list):
            values[name] = tuple(value)
    return getattr(contract, header["kind"])(**values)


def _body(contract: Any, values: dict[str, Any]) -> Any:
    # JSON has no tuples.
    return contract.Body(
        **{name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
    )
