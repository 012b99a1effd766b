"""The layout of an array of a dataset. The first dimension of every array is `sample`.

Labels are a few large chunks; curves are one chunk per shard group; pictures, clips and meshes are
one chunk per sample, and the chunks of a shard group lie in one shard. Every chunk is
`bytes(little) -> zstd(3) -> crc32c`, but for clips and trajectories: see
`stickslip_schemas.format.codecs`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import prod
from typing import Any, Literal

FORMAT: Literal["stickslip-dataset/3"] = "stickslip-dataset/3"

LABEL_SAMPLES = 65_536
"""Samples in a chunk of a label: a million samples have 16 files of each label."""
LEAST_LABEL_SAMPLES = 4_096
LABEL_CHUNK_BYTES = 2**21
"""A chunk of a label that is a long vector has fewer samples, to be no larger than this [bytes]."""

SAMPLE_KEY_BYTES = 32

REGIONS = {
    "cloth": "all cloth",
    "landed": "cloth within 40 mm of the floor",
    "edge": "a band of 4 px along the silhouette",
}
"""Regions in which the quality of a clip is measured."""

DERIVATIVE_BY = "derivative_by"
"""Attribute of an array of derivatives: the name of the parameter."""

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """One array: `shape` and `dimensions` are of a single sample."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    dimensions: tuple[str, ...]
    description: str
    fill: float | int | bool = 0
    per_sample: bool = False
    """True if a chunk is one sample and the chunks of a shard group lie in one shard."""
    is_recorded: bool = False
    """True if the values come from the record of the simulation, not from a label or from the
    renderer.
    """
    categories: tuple[str, ...] = ()
    """Names of the codes 0, 1, ... of a categorical label."""
    is_trajectory: bool = False
    """True if the first dimension of a sample is time and the values change slowly: coded as a
    trajectory.
    """
    is_clip: bool = False
    """True of pictures (frame, y, x, rgb) that change slowly from frame to frame: coded as a clip.
    """
    attributes: dict[str, Any] = field(default_factory=dict, hash=False)
    """Further attributes of the Zarr array."""

    @property
    def sample_bytes(self) -> int:
        """Decoded size of one sample [bytes]."""
        # NumPy stores a bool in a byte. Other names of types end with their bits.
        bits = 8 if self.dtype == "bool" else int(self.dtype.lstrip("uintfloa"))
        return prod(self.shape) * bits // 8

    @property
    def is_label(self) -> bool:
        """True of one number of a sample, or a small vector."""
        return not self.per_sample and len(self.shape) < 2

    @property
    def identity(self) -> dict[str, Any]:
        """All that decides on the bytes of the array, as JSON: everything but the description."""
        identity = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name != "description"
        }
        return identity | {"fill": repr(self.fill)}  # NaN has no JSON form

    def shard_path(self, shard: int) -> str:
        """Path, inside the dataset, of file `shard` of the array [Zarr v3 default chunk keys]."""
        return "/".join([self.name, "c", str(shard), *("0" for _ in self.shape)])


def array(
    name: str, text: str, dtype: str = "float64", of: Mapping[str, int] | None = None, **more: Any
) -> ArrayLayout:
    """Return the layout of an array of numbers.

    A rejected sample has NaN, -1 or false, and 0 if unsigned.

    `of` has the size of each dimension of a sample, by name; a sample is one number without it.
    """
    # Signed integers have -1 for missing values, for they have no NaN.
    of = of or {}
    missing = {"f": NAN, "i": -1, "b": False}.get(dtype[0], 0)
    return ArrayLayout(
        name, dtype, tuple(of.values()), tuple(of), text, **{"fill": missing, **more}
    )


SPLITS = ("train", "validation", "test")
"""Names of the splits, in the order of their numbers in the array `split`."""

# Readers of any kind of dataset may rely on these.
COMMON_ARRAYS = (
    array("split", "0 train, 1 validation, 2 test", "uint8", categories=SPLITS),
    array("valid", "false where the sample was rejected; the manifest says why", "bool"),
    array("sample_key", "content key (SHA-256) of the sample", "uint8", {"byte": SAMPLE_KEY_BYTES}),
)
"""The arrays of every dataset."""


def describe(array: ArrayLayout) -> dict[str, Any]:
    """Return the attributes that the Zarr array carries."""
    # Other programs show the description, for example xarray.
    attributes: dict[str, Any] = {"description": array.description, **array.attributes}
    if array.categories:
        attributes["categories"] = list(array.categories)
    return attributes


def shown_frames(count: int, instants: int) -> tuple[int, ...]:
    """Return the instants that a clip of `count` frames shows, of `instants`.

    They begin with the first instant and are evenly spread.
    """
    if not 1 <= count <= instants:
        raise ValueError(f"frames must be from 1 to {instants}, and is {count}")
    return tuple(position * instants // count for position in range(count))
