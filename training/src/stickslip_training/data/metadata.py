"""Check the Zarr metadata of a dataset against the contract.

The reader computes with `stickslip_schemas.format.manifest` and not with the metadata, so the two must agree before
anything is read: a chunk of another shape or codec would otherwise be nonsense that passes its checksum.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from stickslip_schemas.format.codecs import axes_order, packing
from stickslip_schemas.spec.arrays import ArrayLayout

from stickslip_training.data.errors import InvalidDatasetError

GROUP_METADATA = "zarr.json"


def parse_metadata(data: bytes, path: str) -> dict[str, Any]:
    """Return the JSON object in `data`."""
    try:
        metadata = json.loads(data)
    except ValueError as error:
        raise InvalidDatasetError(f"{path} is no JSON: {error}") from None
    if not isinstance(metadata, dict):
        raise InvalidDatasetError(f"{path} must be a JSON object, and is a {type(metadata).__name__}")
    return metadata


def consolidated(group: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the metadata of the arrays by name, where the group's carry them; raise where it is no Zarr v3 group."""
    if group.get("zarr_format") != 3 or group.get("node_type") != "group":
        raise InvalidDatasetError(f"{GROUP_METADATA} must be of a Zarr v3 group")
    inline = group.get("consolidated_metadata")
    if not isinstance(inline, dict) or not isinstance(inline.get("metadata"), dict):
        return None
    return dict(inline["metadata"])


def check_array(metadata: Any, array: ArrayLayout, *, sample_count: int, samples_per_file: int) -> None:
    """Raise InvalidDatasetError where the metadata of one array contradict its layout."""
    if not isinstance(metadata, dict):
        raise InvalidDatasetError(f"array {array.name}: there must be metadata, and there are none")
    shard = [samples_per_file, *array.shape]
    expected: dict[str, Any] = {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [sample_count, *array.shape],
        "data_type": array.dtype,
        "dimension_names": ["sample", *array.dimensions],
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shard}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": _codecs(array),
        "fill_value": "NaN" if array.fill != array.fill else array.fill,
        "storage_transformers": [],
    }
    defaults = _DEFAULTS | ({"bytes": {"endian": "little"}} if np.dtype(array.dtype).itemsize == 1 else {})
    found = {
        **metadata,
        "chunk_key_encoding": _normalised(metadata.get("chunk_key_encoding"), defaults),
        "codecs": _all_normalised(metadata.get("codecs"), defaults),
        "storage_transformers": metadata.get("storage_transformers") or [],
    }
    for field, rule in expected.items():
        if found.get(field) != rule:
            raise InvalidDatasetError(
                f"array {array.name}: {field} must be {json.dumps(rule)}, and is {json.dumps(found.get(field))}"
            )


_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c", "configuration": {}}


def _codecs(array: ArrayLayout) -> list[dict[str, Any]]:
    compressor: dict[str, Any] = {"name": "zstd" if packing(array) is None else "blosc", "configuration": {}}
    chunk: list[dict[str, Any]] = [_LITTLE, compressor, _CRC]
    if (order := axes_order(array)) is not None:
        chunk.insert(0, {"name": "transpose", "configuration": {"order": list(order)}})
    if not array.per_sample:
        return chunk
    configuration = {
        "chunk_shape": [1, *array.shape],
        "codecs": chunk,
        "index_codecs": [_LITTLE, _CRC],
        "index_location": "end",
    }
    return [{"name": "sharding_indexed", "configuration": configuration}]


_DEFAULTS = {"default": {"separator": "/"}, "sharding_indexed": {"index_location": "end"}}
"""Configurations that the metadata may leave out; for values of one byte, the order of bytes, too."""


def _normalised(named: Any, defaults: Mapping[str, dict[str, str]]) -> Any:
    """Give a codec or an encoding its configuration, but for what a reader need not know: the level of zstd, all of
    blosc's."""
    named = {"name": named} if isinstance(named, str) else named
    if not isinstance(named, dict):
        return named
    name = named.get("name")
    configuration = defaults.get(str(name), {}) | (named.get("configuration") or {})
    nested = [key for key in ("codecs", "index_codecs") if key in configuration]
    inner = {key: _all_normalised(configuration[key], defaults) for key in nested}
    return {"name": name, "configuration": {} if name in ("zstd", "blosc") else configuration | inner}


def _all_normalised(codecs: Any, defaults: Mapping[str, dict[str, str]]) -> Any:
    return [_normalised(codec, defaults) for codec in codecs] if isinstance(codecs, list) else codecs
