"""Check the Zarr metadata of a dataset against the contract.

The reader computes with `stickslip_schemas.format.layout` and not with the metadata, so the two must agree before
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
        "storage_transformers": [],
    }
    found = {
        **metadata,
        "chunk_key_encoding": _with_default(metadata.get("chunk_key_encoding"), {"separator": "/"}),
        "codecs": _normalised_codecs(metadata.get("codecs"), array),
        "storage_transformers": metadata.get("storage_transformers") or [],
    }
    for field, rule in expected.items():
        if found.get(field) != rule:
            raise InvalidDatasetError(
                f"array {array.name}: {field} must be {json.dumps(rule)}, and is {json.dumps(found.get(field))}"
            )
    if not _same_fill(metadata.get("fill_value"), array.fill):
        raise InvalidDatasetError(
            f"array {array.name}: fill_value must be {array.fill}, and is {json.dumps(metadata.get('fill_value'))}"
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


def _normalised_codecs(codecs: Any, array: ArrayLayout) -> Any:
    """Give every codec a configuration, and drop what a reader need not know: the level of zstd, all of blosc's."""
    if not isinstance(codecs, list):
        return codecs
    result = []
    for codec in codecs:
        codec = {"name": codec} if isinstance(codec, str) else codec
        if not isinstance(codec, dict):
            return codecs
        configuration = dict(codec.get("configuration") or {})
        if codec.get("name") in ("zstd", "blosc"):
            configuration = {}
        elif codec.get("name") == "bytes" and np.dtype(array.dtype).itemsize == 1:
            configuration.setdefault("endian", "little")  # a byte has no order
        elif codec.get("name") == "sharding_indexed":
            configuration.setdefault("index_location", "end")
            configuration["codecs"] = _normalised_codecs(configuration.get("codecs"), array)
            configuration["index_codecs"] = _normalised_codecs(configuration.get("index_codecs"), array)
        result.append({"name": codec.get("name"), "configuration": configuration})
    return result


def _with_default(item: Any, configuration: dict[str, Any]) -> Any:
    item = {"name": item} if isinstance(item, str) else item
    if not isinstance(item, dict):
        return item
    return {"name": item.get("name"), "configuration": {**configuration, **(item.get("configuration") or {})}}


def _same_fill(found: Any, fill: float | int | bool) -> bool:
    if isinstance(fill, float) and np.isnan(fill):
        return bool(found == "NaN")
    return bool(found == fill)
