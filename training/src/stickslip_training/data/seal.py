"""The three files that vouch for all others of a version, and for one another.

`manifest.json` has the SHA-256 of every file but these three. The attribute `manifest_sha256` of the group's metadata
is that of the manifest. `manifest.sha256`, in the form of sha256sum, has those of both. So a bit that is flipped in any
of the three shows.
"""

from typing import Any

from stickslip_schemas.keys import sha256
from stickslip_schemas.manifest import MANIFEST_NAME

from stickslip_training.data.errors import CorruptDataError, InvalidDatasetError, MissingFileError
from stickslip_training.data.metadata import GROUP_METADATA, parse_metadata
from stickslip_training.data.sources import Source

SEAL_NAME = "manifest.sha256"


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
    digest = sha256(manifest)
    expected = {MANIFEST_NAME: digest, GROUP_METADATA: sha256(group)}
    stated = _parse(seal, source)
    for name, found in expected.items():
        if stated.get(name) != found:
            raise CorruptDataError(f"{source}/{name} has SHA-256 {found}, and {SEAL_NAME} says {stated.get(name)}")
    if seal != sealed(expected):
        raise CorruptDataError(
            f"{source}/{SEAL_NAME} must have a line each for {', '.join(expected)}, and nothing else"
        )
    metadata = parse_metadata(group, f"{source}/{GROUP_METADATA}")
    attributes = metadata.get("attributes")
    named = attributes.get("manifest_sha256") if isinstance(attributes, dict) else None
    if named != digest:
        raise CorruptDataError(
            f"{source}/{GROUP_METADATA}: manifest_sha256 must be that of {MANIFEST_NAME}, {digest}, and is {named}"
        )
    return digest, metadata, manifest


def sealed(digests: dict[str, str]) -> bytes:
    """Return the bytes of `manifest.sha256`: SHA-256, two spaces and name, a line for each file."""
    return "".join(f"{digest}  {name}\n" for name, digest in digests.items()).encode()


def _parse(seal: bytes, source: Source) -> dict[str, str]:
    try:
        lines = [line.split("  ") for line in seal.decode("ascii").splitlines()]
        return {name: digest for digest, name in lines}
    except ValueError:
        raise CorruptDataError(f"{source}/{SEAL_NAME} must have lines as of sha256sum: a digest and a name") from None
