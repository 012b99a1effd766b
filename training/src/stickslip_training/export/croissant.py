"""Croissant metadata of an export [ML Commons, Croissant 1.0], for search engines and loaders of data sets.

Every file has its SHA-256. Parquet files have a record set, too, whose fields are the columns. Croissant cannot say how
to read arrays from HDF5 or from tar files, so there they are described as variables only.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout

from stickslip_training.export.content import Content

CROISSANT_NAME = "croissant.json"

_FORMATS = {
    ".h5": "application/x-hdf5",
    ".json": "application/json",
    ".md": "text/markdown",
    ".obj": "model/obj",
    ".parquet": "application/x-parquet",
    ".tar": "application/x-tar",
}
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "excludes": "cr:excludes",
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "readLines": "cr:readLines",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
    "unArchive": "cr:unArchive",
    "value": "cr:value",
}


def document(content: Content, files: dict[str, Path], *, licence: str | None = None) -> bytes:
    """Return the metadata of an export that consists of `files`, by their paths in it."""
    described: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": content.title,
        "identifier": content.name,
        "description": _description(content),
        "version": f"{content.reader.manifest.version}.0.0",
        "citeAs": f"{content.name}, SHA-256 of its manifest: {content.reader.manifest_digest}",
        **({"license": licence} if licence else {}),
        "variableMeasured": [_variable(array) for array in content.arrays],
        "distribution": [_file(name, path) for name, path in sorted(files.items())],
    }
    if any(name.endswith(".parquet") for name in files):
        described["distribution"].append(
            {
                "@type": "cr:FileSet",
                "@id": "parquet",
                "name": "parquet",
                "encodingFormat": _FORMATS[".parquet"],
                "includes": "data/*.parquet",
            }
        )
        fields = [_field(array) for array in content.arrays]
        described["recordSet"] = [
            {
                "@type": "cr:RecordSet",
                "@id": "samples",
                "name": "samples",
                "key": {"@id": "samples/slot"},
                "field": fields,
            }
        ]
    return (json.dumps(described, indent=2, allow_nan=False) + "\n").encode()


def _description(content: Content) -> str:
    first = (type(content.reader.spec).__doc__ or content.reader.kind).strip().splitlines()[0]
    made = f"{len(content.slots)} samples of the dataset {content.name}, which stickslip simulated."
    certificate = content.reader.manifest.certificate
    vouched = f" The physics was checked against theory: certificate {certificate}." if certificate else ""
    return f"{first} {made}{vouched}"


def _variable(array: ArrayLayout) -> dict[str, Any]:
    shape = ", ".join(f"{name} {size}" for name, size in zip(array.dimensions, array.shape, strict=True))
    codes = ", ".join(f"{code} {name}" for code, name in enumerate(array.categories))
    details = [array.description, f"type {array.dtype}", *([f"shape {shape}"] * bool(shape))]
    described = "; ".join([*details, *([f"codes: {codes}"] * bool(codes))])
    return {"@type": "sc:PropertyValue", "name": array.name, "description": described}


def _file(name: str, path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": _FORMATS.get(Path(name).suffix, "application/octet-stream"),
        "sha256": digest,
    }


def _field(array: ArrayLayout) -> dict[str, Any]:
    kind = np.dtype(array.dtype).kind
    is_split = array.categories == SPLITS
    shape = {"isArray": True, "arrayShape": ",".join(map(str, array.shape))} if array.shape else {}
    return {
        "@type": "cr:Field",
        "@id": f"samples/{array.name}",
        "name": array.name,
        "description": array.description,
        "dataType": ["sc:Integer", "cr:Split"]
        if is_split
        else {"f": "sc:Float", "b": "sc:Boolean"}.get(kind, "sc:Integer"),
        "source": {"fileSet": {"@id": "parquet"}, "extract": {"column": array.name}},
        **shape,
    }
