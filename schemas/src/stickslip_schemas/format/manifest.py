"""The manifest of a dataset version: its contents, its origin, and the digests that verify it.

Three files vouch for all others and for one another. `manifest.json` has the SHA-256 of every file
but these three. In a version of many samples it has those of its **sections** instead,
`manifest/0.json` and so on, each of which lists the keys, rejections and files of some thousand
samples: a tree of digests, so that nobody reads all lists to open a version. `Contents` reads both
forms. The attribute `manifest_sha256` of the root's `zarr.json` is the SHA-256 of the manifest.
`manifest.sha256` has those of both, in the form that `sha256sum --check` reads. So a bit that flips
in any of these files shows.
"""

import json
import re
from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import FailFast, Field, model_validator

from stickslip_schemas.base import Document, Int, Reason, Sha256, sha256
from stickslip_schemas.kinds import AnyJobSpec, registered
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.arrays import COMMON_ARRAYS, FORMAT, ArrayLayout
from stickslip_schemas.spec.cameras import Camera
from stickslip_schemas.spec.jobs import JobSpec, Quality


def layout(spec: JobSpec) -> tuple[ArrayLayout, ...]:
    """Return the arrays of the dataset of `spec`.

    Raises UnknownKindError if its class is not registered.
    """
    return (*registered(spec).arrays(), *COMMON_ARRAYS)


def bytes_estimate(spec: JobSpec) -> int:
    """Return the size of the arrays of the dataset of `spec` before compression [bytes]."""
    return spec.sample_count * sum(array.sample_bytes for array in layout(spec))


MANIFEST_NAME = "manifest.json"
GROUP_NAME = "zarr.json"
SEAL_NAME = "manifest.sha256"
SIGNATURE_NAME = "manifest.sha256.sig"
"""Signature of the seal, if somebody signed the version."""
SEALED_NAMES = (MANIFEST_NAME, GROUP_NAME, SEAL_NAME)
"""The files of a version that its manifest does not list."""

MANIFEST_ATTRIBUTE = "manifest_sha256"

SECTION_SAMPLES = 10_000
"""Samples of a section, rounded down to whole shards. A smaller version has no sections."""


def section_samples(spec: JobSpec) -> int:
    """Return the number of samples of each section but the last."""
    return max(1, SECTION_SAMPLES // spec.samples_per_shard) * spec.samples_per_shard


def has_sections(spec: JobSpec) -> bool:
    """Return whether a version of a spec has sections."""
    return spec.sample_count > SECTION_SAMPLES


def section_path(number: int) -> str:
    """Return the path of a section inside of the version."""
    return f"manifest/{number}.json"


# Chunk keys of Zarr: the number of the shard follows `c/`.
_SHARD = re.compile(r"[^/]+/c/(\d{1,18})(?:/|$)")


T = TypeVar("T")

LongTuple = Annotated[tuple[T, ...], FailFast()]
"""A list that may be long: its first wrong item is the only one that an error names."""


class FileEntry(Document):
    """A file of a dataset: its path inside the dataset, its digest and its size in bytes."""

    path: str = Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_./-]*$")
    sha256: Sha256
    size: Int = Field(ge=0)


class Rejection(Document):
    """Why a slot is empty."""

    slot: Int = Field(ge=0)
    sample_key: Sha256
    reason: Reason
    message: str
    labels: dict[str, Any] = Field(description="the parameters of the sample")


class ManifestSection(Document):
    """Part of a manifest: samples of consecutive shards, and the files of their arrays.

    Files of labels are not among them.
    """

    first: Int = Field(ge=0, description="slot of the first sample")
    sample_keys: LongTuple[Sha256] = Field(min_length=1, description="by slot")
    rejections: LongTuple[Rejection]
    files: LongTuple[FileEntry]

    @property
    def end(self) -> int:
        return self.first + len(self.sample_keys)


class BrokenSectionError(ValueError):
    """A section of a manifest contradicts the manifest."""


class BrokenSealError(ValueError):
    """The manifest, the root's metadata and the seal of a version do not fit each other."""


class Psnr(Document):
    """PSNR of the clips of a version over a region."""

    clips: Int = Field(description="valid clips that were measured and show the region")
    median: float = Field(description="[dB]")
    worst: float = Field(description="exceeded by 99 % of the clips [dB]")
    deviation: float = Field(
        description="median of the standard deviations of a clip's estimate [dB]"
    )


class Pictures(Document):
    """Quality of the pictures of a version."""

    quality: Quality
    psnr: dict[str, Psnr] = Field(
        description="by region: cloth, its landed part, its edge; none for what is no cloth"
    )
    frame_share: float | None = Field(
        default=None,
        description="share of the frame that is cloth, mean of the valid samples; null: no cloth",
    )
    device: str = Field(
        default="cpu",
        description=(
            "what Cycles computed on: `cpu`, or a sort of GPU, whose name and driver are "
            "in the build `render`"
        ),
    )


class Manifest(Document):
    """Everything about a version that is not in its arrays.

    A version exists when its manifest is committed.
    """

    format: Literal["stickslip-dataset/3"] = FORMAT
    dataset: str
    version: int = Field(ge=1)
    spec: AnyJobSpec
    spec_digest: Sha256
    builds: Builds
    certificate: Sha256 | None = Field(
        default=None, description="digest of the certificate of preset and build; null: none"
    )
    cameras: tuple[Camera, ...] = Field(
        description=(
            "of the array `views`, in its order, or of the viewpoints, by name; empty "
            "where nothing is rendered"
        )
    )
    pictures: Pictures | None = Field(
        default=None, description="quality of the pictures; null: there are none"
    )
    sample_count: int = Field(ge=1, description="slots, the rejected ones included")
    valid_count: int = Field(ge=0)
    split_counts: dict[str, int] = Field(description="valid samples by split")
    rejection_counts: dict[str, int] = Field(description="rejected samples by reason")
    sections: LongTuple[FileEntry] = Field(
        default=(),
        description=(
            "files that list samples and the files of their shards, by slot; none in a "
            "small version"
        ),
    )
    rejections: LongTuple[Rejection] = Field(
        description="empty where there are sections, which have them"
    )
    sample_keys: LongTuple[Sha256] = Field(
        description="by slot; empty where there are sections, which have them"
    )
    files: LongTuple[FileEntry] = Field(
        description="every file of the version, by path, but the three that vouch for it (this "
        "one, the root's "
        "zarr.json and manifest.sha256), the sections, and what the sections list"
    )

    @model_validator(mode="after")
    def _has_its_sections(self) -> Self:
        if not self.sections:
            return self
        # Sections are numbered by the samples that they list.
        expected = [
            section_path(number)
            for number in range(-(-self.sample_count // section_samples(self.spec)))
        ]
        paths = [section.path for section in self.sections]
        if paths != expected:
            raise ValueError(
                f"sections must be {len(expected)}, from {expected[0]} to {expected[-1]}; got "
                f"{paths[:5]}"
            )
        # Each list stands in one file: two could contradict each other.
        if self.sample_keys or self.rejections:
            raise ValueError(
                "sample_keys and rejections must be empty, for there are sections, which have them"
            )
        return self

    @property
    def acceptance_rate(self) -> float:
        """Share of the slots that hold a valid sample."""
        return self.valid_count / self.sample_count


class Contents:
    """The lists of a manifest.

    Sections are read when they are asked for, and checked against their digests.

    Methods raise BrokenSectionError for a section that is not what the manifest says, and what
    `read` raises.
    """

    CACHED_SECTIONS = 2
    """Number of sections in memory: the last that were read."""

    def __init__(self, manifest: Manifest, read: Callable[[FileEntry], bytes]) -> None:
        self.manifest = manifest
        self._read = read
        self._samples = (
            section_samples(manifest.spec) if manifest.sections else manifest.sample_count
        )
        # `lru_cache` is safe for threads. At most two sections are in memory, each of some MB.
        self.section = lru_cache(self.CACHED_SECTIONS)(self._section)
        self._files_of = lru_cache(1)(
            lambda number: {file.path: file for file in self.section(number).files}
        )

    def number_of(self, slot: int) -> int:
        """Return the number of the section of a sample; 0 if all is in the manifest itself."""
        return slot // self._samples

    def sections(self) -> Iterator[ManifestSection]:
        for number in range(max(1, len(self.manifest.sections))):
            yield self.section(number)

    def files(self) -> Iterator[FileEntry]:
        """Yield every file of the version, the sections included.

        The three files that vouch for the version are not listed.
        """
        # The sections are files of the version as well.
        yield from self.manifest.files
        yield from self.manifest.sections
        for section in self.sections() if self.manifest.sections else ():
            yield from section.files

    def file(self, path: str) -> FileEntry | None:
        """Return the file at a path of the version; None if it lists none.

        At most one section is read.
        """
        entry = self._listed_files.get(path)
        shard = _SHARD.match(path)
        if entry is not None or shard is None or not self.manifest.sections:
            return entry
        # The number of the shard is in its path, and tells the section that lists it.
        # A shard beyond the last sample is in no section.
        slot = int(shard[1]) * self.manifest.spec.samples_per_shard
        return (
            self._files_of(self.number_of(slot)).get(path)
            if slot < self.manifest.sample_count
            else None
        )

    @cached_property
    def _listed_files(self) -> dict[str, FileEntry]:
        return {file.path: file for file in [*self.manifest.files, *self.manifest.sections]}

    def rejections(self) -> Iterator[Rejection]:
        for section in self.sections():
            yield from section.rejections

    def sample_keys(self) -> Iterator[Sha256]:
        for section in self.sections():
            yield from section.sample_keys

    def _section(self, number: int) -> ManifestSection:
        """Return a section.

        A manifest without sections is like one with one section, but for the files.
        """
        manifest = self.manifest
        # A small version has all lists in the manifest itself.
        if not manifest.sections:
            return ManifestSection.model_construct(
                first=0, sample_keys=manifest.sample_keys, rejections=manifest.rejections, files=()
            )
        entry = manifest.sections[number]
        # The digest in the manifest vouches for the section, and the seal for the manifest.
        data = self._read(entry)
        digest = sha256(data)
        if digest != entry.sha256:
            raise BrokenSectionError(
                f"{entry.path} has SHA-256 {digest}, and {MANIFEST_NAME} says {entry.sha256}"
            )
        try:
            section = ManifestSection.model_validate_json(data)
        except ValueError as error:
            raise BrokenSectionError(
                f"{entry.path} is no section of a manifest: {error}"
            ) from error
        # A section of another version may be whole, too: it must be of these samples.
        first = number * self._samples
        end = min(first + self._samples, manifest.sample_count)
        if (section.first, section.end) != (first, end):
            raise BrokenSectionError(
                f"{entry.path} must list the samples {first} to {end - 1}, and lists "
                f"{section.first} to "
                f"{section.end - 1}"
            )
        return section


def seal_text(manifest: Sha256, group: Sha256) -> bytes:
    """Return the bytes of `manifest.sha256`.

    They are made from the digests of the manifest and of the `zarr.json` of the root.
    """
    return f"{manifest}  {MANIFEST_NAME}\n{group}  {GROUP_NAME}\n".encode()


def with_manifest_digest(group: bytes, manifest: Sha256) -> bytes:
    """Return the root's `zarr.json` with the attribute that names the manifest."""
    document = json.loads(group)
    document["attributes"] = {**document.get("attributes", {}), MANIFEST_ATTRIBUTE: manifest}
    return json.dumps(document, indent=2).encode()


def check_seal(manifest: bytes, group: bytes, seal: bytes) -> Sha256:
    """Return the digest of the manifest.

    Raises BrokenSealError if one of the three files has changed.
    """
    digests = {MANIFEST_NAME: sha256(manifest), GROUP_NAME: sha256(group)}
    # The seal names both files.
    stated = _seal_digests(seal)
    for name, digest in digests.items():
        if stated.get(name) != digest:
            raise BrokenSealError(
                f"{name} has SHA-256 {digest}, and {SEAL_NAME} says {stated.get(name)}"
            )
    # The seal itself has no other bytes: a changed line break shows.
    if seal != seal_text(*digests.values()):
        raise BrokenSealError(
            f"{SEAL_NAME} must have one line each for {', '.join(digests)}, and no other line"
        )
    # The root's metadata names the manifest, so that a Zarr reader can find it.
    try:
        named = json.loads(group)["attributes"][MANIFEST_ATTRIBUTE]
    except (ValueError, KeyError, TypeError) as error:
        raise BrokenSealError(
            f"{GROUP_NAME} must have the attribute {MANIFEST_ATTRIBUTE}"
        ) from error
    if named != digests[MANIFEST_NAME]:
        raise BrokenSealError(
            f"{GROUP_NAME}: {MANIFEST_ATTRIBUTE} must be that of {MANIFEST_NAME}, "
            f"{digests[MANIFEST_NAME]}, "
            f"and is {named}"
        )
    return digests[MANIFEST_NAME]


def _seal_digests(seal: bytes) -> dict[str, str]:
    try:
        # `sha256sum` puts two spaces between digest and name.
        lines = [line.split("  ") for line in seal.decode("ascii").splitlines()]
        return {name: digest for digest, name in lines}
    except ValueError as error:
        raise BrokenSealError(
            f"{SEAL_NAME} must have lines as of sha256sum: a digest and a name"
        ) from error
