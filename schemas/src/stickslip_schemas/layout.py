"""Which arrays a dataset of each kind has. The first dimension of every array is `sample`.

Labels and curves are one chunk per shard group; pictures, clips and meshes are one chunk per sample, and the chunks of
a shard group lie in one shard. Every chunk is `bytes(little) -> zstd(3) -> crc32c`.
"""

from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from stickslip_schemas.jobs import ClothDragSpec, Material, RodHangSpec, Texture, Viewpoint
from stickslip_schemas.tasks import RodSimulation

FORMAT = "stickslip-dataset/1"

SAMPLE_KEY_BYTES = 32


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """One array: `shape` and `dimensions` are those of a single sample."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    dimensions: tuple[str, ...]
    description: str
    fill: float | int | bool = 0
    per_sample: bool = False
    """True where a chunk is one sample and the chunks of a shard group lie in one shard."""
    categories: tuple[str, ...] = ()
    """Names of the codes 0, 1, ... of a categorical label."""

    @property
    def sample_bytes(self) -> int:
        """Decoded size of one sample [bytes]."""
        return prod(self.shape) * np.dtype(self.dtype).itemsize

    def shard_path(self, shard: int) -> str:
        """Path, inside the dataset, of the file that holds shard group `shard` [Zarr v3 default chunk keys]."""
        return "/".join([self.name, "c", str(shard), *("0" for _ in self.shape)])


def layout(spec: RodHangSpec | ClothDragSpec) -> tuple[ArrayLayout, ...]:
    """Return the arrays of the dataset of `spec`, in the order of their names in the documentation."""
    own = _rod_arrays(spec) if isinstance(spec, RodHangSpec) else _cloth_arrays(spec)
    return (*own, *_COMMON)


_COMMON = (
    ArrayLayout("split", "uint8", (), (), "0 train, 1 validation, 2 test", categories=("train", "validation", "test")),
    ArrayLayout("valid", "bool", (), (), "false where the sample was rejected; the manifest says why", fill=False),
    ArrayLayout("sample_key", "uint8", (SAMPLE_KEY_BYTES,), ("byte",), "content key (SHA-256) of the sample"),
)

_NAN = float("nan")


def _rod_arrays(spec: RodHangSpec) -> tuple[ArrayLayout, ...]:
    points = RodSimulation.model_fields["points"].default
    curve = ("point", "xyz")
    views = (
        ArrayLayout("views", "uint8", (4, 224, 224, 3), ("view", "y", "x", "rgb"), "sRGB pictures", per_sample=True),
        ArrayLayout("color", "float32", (3,), ("rgb",), "colour of the rod, linear RGB, 0 to 1", fill=_NAN),
    )
    return (
        ArrayLayout(
            "centerline",
            "float32",
            (points, 3),
            curve,
            "positions over L at uniform arc length, clamp first",
            fill=_NAN,
        ),
        ArrayLayout(
            "curvature",
            "float32",
            (points, 3),
            ("point", "strain"),
            "(twist, bend1, bend2) times L",
            fill=_NAN,
        ),
        ArrayLayout(
            "frame",
            "float32",
            (points, 3, 3),
            ("point", "xyz", "director"),
            "columns d1 (tangent), d2, d3",
            fill=_NAN,
        ),
        *(() if spec.views is None else views),
        ArrayLayout("gamma", "float64", (), (), "weight over bending stiffness [Eq. 5.2a of the thesis]", fill=_NAN),
        ArrayLayout("phi0", "float64", (), (), "natural twist times L [rad]", fill=_NAN),
        ArrayLayout("phi1", "float64", (), (), "natural curvature times L [rad]", fill=_NAN),
        ArrayLayout("energy", "float64", (), (), "elastic and gravity energy over EI/L", fill=_NAN),
        ArrayLayout("multistable", "bool", (), (), "another stable shape of the same rod was found", fill=False),
        ArrayLayout(
            "self_contact_distance",
            "float64",
            (),
            (),
            "least distance over L at which the centreline passes another part of itself; infinite where it does not",
            fill=_NAN,
        ),
        ArrayLayout("reach", "float64", (), (), "largest distance over L from the vertical of the clamp", fill=_NAN),
    )


def _cloth_arrays(spec: ClothDragSpec) -> tuple[ArrayLayout, ...]:
    def codes(name: str, kind: type[Material] | type[Texture] | type[Viewpoint]) -> ArrayLayout:
        return ArrayLayout(name, "int16", (), (), f"code of the {name}", fill=-1, categories=tuple(kind))

    return (
        ArrayLayout(
            "video",
            "uint8",
            (spec.frames, 224, 224, 3),
            ("frame", "y", "x", "rgb"),
            "sRGB clip",
            per_sample=True,
        ),
        codes("material", Material),
        ArrayLayout("mu", "float64", (), (), "friction coefficient", fill=_NAN),
        codes("texture", Texture),
        codes("viewpoint", Viewpoint),
    )


def describe(array: ArrayLayout) -> dict[str, Any]:
    """Return the attributes that the Zarr array carries."""
    attributes: dict[str, Any] = {"description": array.description}
    if array.categories:
        attributes["categories"] = list(array.categories)
    return attributes
