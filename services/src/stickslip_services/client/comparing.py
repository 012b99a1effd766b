"""Differences between two dataset versions, by their manifests."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from stickslip_schemas.format.layout import layout
from stickslip_schemas.format.manifest import Contents, Manifest
from stickslip_schemas.spec.arrays import ArrayLayout

Difference = tuple[str, str, str]
"""A property with its values in both versions."""


def differences(left: Contents, right: Contents) -> list[Difference]:
    """Return the differences in spec, builds, certificate, arrays and labels, samples, rejections and files."""
    a, b = left.manifest, right.manifest
    return [
        *_of_mappings("spec", _flat(a.spec.model_dump(mode="json")), _flat(b.spec.model_dump(mode="json"))),
        *_of_mappings("build of", a.builds.model_dump(), b.builds.model_dump()),
        *_of_mappings("", {"certificate": a.certificate}, {"certificate": b.certificate}),
        *_of_mappings("array", _arrays(a), _arrays(b)),
        *_of_mappings("", _counts(left), _counts(right)),
        *_of_samples(left, right),
        *_of_files(left, right),
    ]


def _of_mappings(prefix: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[Difference]:
    for name in sorted(a.keys() | b.keys()):
        left, right = a.get(name), b.get(name)
        if left != right:
            yield f"{prefix} {name}".strip(), _text(left), _text(right)


def _text(value: Any) -> str:
    return "-" if value is None else str(value)


def _flat(value: Any, path: str = "") -> dict[str, Any]:
    """Return a JSON document as paths and values; a list of plain values is one value."""
    if isinstance(value, dict):
        items = [(f"{path}.{key}" if path else str(key), item) for key, item in value.items()]
        return {name: leaf for place, item in items for name, leaf in _flat(item, place).items()}
    return {path: value}


def _arrays(manifest: Manifest) -> dict[str, str]:
    return {array.name: _described(array) for array in layout(manifest.spec)}


def _described(array: ArrayLayout) -> str:
    codes = f", one of {', '.join(map(str, array.categories))}" if array.categories else ""
    return f"{array.dtype} {list(array.shape)}{codes}"


def _counts(contents: Contents) -> dict[str, Any]:
    manifest = contents.manifest
    reasons = Counter(f"rejected, {rejection.reason}" for rejection in contents.rejections())
    splits = {f"samples in {split}": count for split, count in manifest.split_counts.items()}
    return {"samples": manifest.sample_count, "valid samples": manifest.valid_count, **splits, **reasons}


def _of_samples(a: Contents, b: Contents) -> Iterator[Difference]:
    """Compare sample keys: equal keys mean equal inputs and builds."""
    keys_a, keys_b = ([bytes.fromhex(key) for key in contents.sample_keys()] for contents in (a, b))
    left, right = set(keys_a), set(keys_b)
    if left != right:
        yield "samples in this version only", str(len(left - right)), str(len(right - left))
    elif keys_a != keys_b:
        yield "order of the samples", "differs", "differs"


def _of_files(a: Contents, b: Contents) -> Iterator[Difference]:
    left, right = ({file.sha256: file.size for file in contents.files()} for contents in (a, b))
    if left.keys() != right.keys():
        only_a = sum(size for digest, size in left.items() if digest not in right)
        only_b = sum(size for digest, size in right.items() if digest not in left)
        yield "bytes of files in this version only", str(only_a), str(only_b)
