"""The manifest of a dataset version: what is in it, what it was made from, and how to check it.

Three files vouch for all others and for one another. `manifest.json` has the SHA-256 of every file but these three. The
attribute `manifest_sha256` of the root's `zarr.json` is that of the manifest. `manifest.sha256` has those of both, in
the form that `sha256sum --check` reads. So a bit that flips in any of the three shows.
"""

import json
from typing import Literal

from pydantic import Field

from stickslip_schemas.base import Document
from stickslip_schemas.builds import Builds
from stickslip_schemas.cameras import Camera
from stickslip_schemas.jobs import Quality
from stickslip_schemas.keys import Sha256, sha256
from stickslip_schemas.kinds import AnyJobSpec
from stickslip_schemas.tasks import FileEntry, Rejection

MANIFEST_NAME = "manifest.json"
GROUP_NAME = "zarr.json"
SEAL_NAME = "manifest.sha256"
SEALED_NAMES = (MANIFEST_NAME, GROUP_NAME, SEAL_NAME)
"""The files of a version that its manifest does not list."""

MANIFEST_ATTRIBUTE = "manifest_sha256"


class BrokenSealError(ValueError):
    """The manifest, the root's metadata and the seal of a version do not fit each other."""


class Pictures(Document):
    """How good the pictures of a version are."""

    quality: Quality
    psnr_db: float = Field(
        description="PSNR of the pixels of cloth or rod, against pictures of 256 samples with another noise, as "
        "measured when the quality was set [dB]"
    )
    gate_db: float | None = Field(
        description="least of what the image gate found in this version [dB]; null: it has no composed pictures"
    )
    frame_share: float | None = Field(
        default=None, description="share of the frame that is cloth, mean of the valid samples; null: no cloth"
    )
    device: str = Field(
        default="cpu",
        description="what Cycles computed on: `cpu`, or a sort of GPU, whose name and driver are in the build `render`",
    )
    direct_slots: tuple[int, ...] = Field(
        description="slots whose pictures the image gate refused to compose: they were rendered directly"
    )


class Manifest(Document):
    """Everything about a version that is not in its arrays. A version exists when its manifest is committed."""

    format: Literal["stickslip-dataset/1"] = "stickslip-dataset/1"
    dataset: str
    version: int = Field(ge=1)
    spec: AnyJobSpec
    spec_digest: Sha256
    builds: Builds
    certificate: Sha256 | None = Field(
        default=None, description="digest of the certificate of preset and build; null: none"
    )
    cameras: tuple[Camera, ...] = Field(
        description="of the array `views`, in its order, or of the viewpoints, by name; empty where nothing is rendered"
    )
    pictures: Pictures | None = Field(default=None, description="how good the pictures are; null: there are none")
    sample_count: int = Field(ge=1, description="slots, the rejected ones included")
    valid_count: int = Field(ge=0)
    split_counts: dict[str, int] = Field(description="valid samples by split")
    rejections: tuple[Rejection, ...]
    sample_keys: tuple[Sha256, ...] = Field(description="by slot")
    files: tuple[FileEntry, ...] = Field(
        description="every file of the version, by path, but the three that vouch for it: this one, the root's "
        "zarr.json and manifest.sha256"
    )

    @property
    def acceptance_rate(self) -> float:
        """Share of the slots that hold a valid sample."""
        return self.valid_count / self.sample_count

    @property
    def size(self) -> int:
        """Size of all files that it lists [bytes]."""
        return sum(file.size for file in self.files)


def seal_text(manifest: Sha256, group: Sha256) -> bytes:
    """Return the bytes of `manifest.sha256`, from the digests of the manifest and of the root's `zarr.json`."""
    return f"{manifest}  {MANIFEST_NAME}\n{group}  {GROUP_NAME}\n".encode()


def with_manifest_digest(group: bytes, manifest: Sha256) -> bytes:
    """Return the root's `zarr.json` with the attribute that names the manifest."""
    document = json.loads(group)
    document["attributes"] = {**document.get("attributes", {}), MANIFEST_ATTRIBUTE: manifest}
    return json.dumps(document, indent=2).encode()


def check_seal(manifest: bytes, group: bytes, seal: bytes) -> Sha256:
    """Return the digest of the manifest; raise BrokenSealError where one of the three files is not as it was made."""
    digests = {MANIFEST_NAME: sha256(manifest), GROUP_NAME: sha256(group)}
    stated = _stated(seal)
    for name, found in digests.items():
        if stated.get(name) != found:
            raise BrokenSealError(f"{name} has SHA-256 {found}, and {SEAL_NAME} says {stated.get(name)}")
    if seal != seal_text(*digests.values()):
        raise BrokenSealError(f"{SEAL_NAME} must have a line each for {', '.join(digests)}, and nothing else")
    try:
        named = json.loads(group)["attributes"][MANIFEST_ATTRIBUTE]
    except (ValueError, KeyError, TypeError) as error:
        raise BrokenSealError(f"{GROUP_NAME} must have the attribute {MANIFEST_ATTRIBUTE}") from error
    if named != digests[MANIFEST_NAME]:
        raise BrokenSealError(
            f"{GROUP_NAME}: {MANIFEST_ATTRIBUTE} must be that of {MANIFEST_NAME}, {digests[MANIFEST_NAME]}, "
            f"and is {named}"
        )
    return digests[MANIFEST_NAME]


def _stated(seal: bytes) -> dict[str, str]:
    try:
        lines = [line.split("  ") for line in seal.decode("ascii").splitlines()]
        return {name: digest for digest, name in lines}
    except ValueError as error:
        raise BrokenSealError(f"{SEAL_NAME} must have lines as of sha256sum: a digest and a name") from error
