"""The three files that vouch for all others of a version, and for one another.

`manifest.json` has the SHA-256 of every file but these three. The attribute `manifest_sha256` of the group's metadata
is that of the manifest. `manifest.sha256`, in the form of sha256sum, has those of both. So a bit that is flipped in any
of the three shows.
"""

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
    try:
        seal = source.read_unlisted(SEAL_NAME)
    except MissingFileError as error:
        raise InvalidDatasetError(
            f"{error}: the version was made before versions had this file, or it was lost. Make the dataset again: "
            "submit its spec to a service of this release"
        ) from None
    group = source.read_unlisted(GROUP_METADATA)
    try:
        digest = check_seal(manifest, group, seal)
    except BrokenSealError as error:
        raise CorruptDataError(f"{source}/{error}") from None
    return digest, parse_metadata(group, f"{source}/{GROUP_METADATA}"), manifest


def read_selection(source: Source, manifest: str) -> Selection:
    """Return the part of the version with this manifest that the source holds, which may be all of it."""
    if not isinstance(source, DirectorySource):
        return Selection()  # servers have whole versions
    try:
        data = source.read_unlisted(SELECTION_NAME)
    except MissingFileError:
        return Selection()
    try:
        part = PartDocument.model_validate_json(data)
    except ValidationError as error:
        raise InvalidDatasetError(f"{source}/{SELECTION_NAME} is damaged: {error}") from None
    if part.manifest != manifest:
        raise InvalidDatasetError(f"{source}/{SELECTION_NAME} is of another version, whose manifest is {part.manifest}")
    return part.selection
