"""Reading the three files that vouch for all others of a version: see `stickslip_schemas.format.manifest`."""

from typing import Any

from pydantic import ValidationError
from stickslip_schemas.format.manifest import SEAL_NAME, BrokenSealError, check_seal
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection

from stickslip_training.data.errors import CorruptDataError, InvalidDatasetError, MissingFileError
from stickslip_training.data.metadata import GROUP_METADATA, parse_metadata
from stickslip_training.data.sources import DirectorySource, Source


def read_sealed(source: Source) -> tuple[str, dict[str, Any], bytes]:
    """Return the manifest's digest, the group's metadata and the manifest's bytes, all checked against one another."""
    manifest = source.read_manifest()
    group = source.fetch(GROUP_METADATA)[0]
    try:
        digest = check_seal(manifest, group, source.fetch(SEAL_NAME)[0])
    except BrokenSealError as error:
        raise CorruptDataError(f"{source}/{error}") from None
    return digest, parse_metadata(group, f"{source}/{GROUP_METADATA}"), manifest


def read_selection(source: Source, manifest: str) -> Selection:
    """Return the part of the version with this manifest that the source holds, which may be all of it."""
    if not isinstance(source, DirectorySource):
        return Selection()  # servers have whole versions
    try:
        data = source.fetch(SELECTION_NAME)[0]
    except MissingFileError:
        return Selection()
    try:
        part = PartDocument.model_validate_json(data)
    except ValidationError as error:
        raise InvalidDatasetError(f"{source}/{SELECTION_NAME} is damaged: {error}") from None
    if part.manifest != manifest:
        raise InvalidDatasetError(f"{source}/{SELECTION_NAME} is of another version, whose manifest is {part.manifest}")
    return part.selection
