"""The manifest of a dataset version: what is in it, what it was made from, and how to check it."""

from typing import Literal

from pydantic import Field

from stickslip_schemas.base import Document
from stickslip_schemas.builds import Builds
from stickslip_schemas.cameras import Camera
from stickslip_schemas.keys import Sha256
from stickslip_schemas.kinds import AnyJobSpec
from stickslip_schemas.tasks import FileEntry, Rejection

MANIFEST_NAME = "manifest.json"


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
    sample_count: int = Field(ge=1, description="slots, the rejected ones included")
    valid_count: int = Field(ge=0)
    split_counts: dict[str, int] = Field(description="valid samples by split")
    rejections: tuple[Rejection, ...]
    sample_keys: tuple[Sha256, ...] = Field(description="by slot")
    files: tuple[FileEntry, ...] = Field(description="every file of the version but this one, by path")

    @property
    def acceptance_rate(self) -> float:
        """Share of the slots that hold a valid sample."""
        return self.valid_count / self.sample_count

    @property
    def size(self) -> int:
        """Size of all files but the manifest [bytes]."""
        return sum(file.size for file in self.files)
