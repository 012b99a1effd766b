"""Which arrays a dataset of each kind has. The first dimension of every array is `sample`.

Labels and curves are one chunk per shard group; pictures, clips and meshes are one chunk per sample, and the chunks of
a shard group lie in one shard. Every chunk is `bytes(little) -> zstd(3) -> crc32c`, but for those of trajectories:
`transpose(sample axes reversed) -> bytes(little) -> blosc(zstd 5, shuffle) -> crc32c`.
"""

from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np

from stickslip_schemas.clips import FRAMES, FRAMES_PER_SECOND, shown_frames
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
    is_trajectory: bool = False
    """True where the first dimension of a sample is time and the values change slowly: coded by `encode_trajectory`."""
    attributes: dict[str, Any] = field(default_factory=dict, hash=False)
    """What else the Zarr array says of itself."""

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
            attributes={"instants": list(shown_frames(spec.frames))},
        ),
        codes("material", Material),
        ArrayLayout("mu", "float64", (), (), "friction coefficient", fill=_NAN),
        codes("texture", Texture),
        codes("viewpoint", Viewpoint),
        ArrayLayout("light_seed", "int32", (), (), "seed of the light", fill=-1),
        ArrayLayout(
            "light",
            "float32",
            (5,),
            ("light",),
            "azimuth and elevation of the lamp [degree], its power over the nominal, albedo and roughness of the floor",
            fill=_NAN,
        ),
        ArrayLayout("side", "int8", (), (), "side to which the drop broke its symmetry, +1 or -1 along x"),
        ArrayLayout(
            "bias",
            "float64",
            (),
            (),
            "what broke the symmetry: horizontal over vertical gravity during the drop",
            fill=_NAN,
        ),
        ArrayLayout("steps", "int32", (), (), "time steps of the solver", fill=-1),
        ArrayLayout("unconverged_steps", "int32", (), (), "steps that stopped short of the tolerance", fill=-1),
        ArrayLayout(
            "worst_residual",
            "float64",
            (),
            (),
            "largest residual force of a node in any step, over the weight of a node",
            fill=_NAN,
        ),
        ArrayLayout(
            "self_intersections",
            "int16",
            (FRAMES,),
            ("instant",),
            "pairs of triangles that cross",
            fill=-1,
            attributes=_INSTANTS,
        ),
        *(
            ArrayLayout(name, "float32", (FRAMES, 3), ("instant", "xyz"), what, fill=_NAN, attributes=_INSTANTS)
            for name, what in (
                ("contact_force", "force of the floor on the cloth [N]"),
                ("holder_force", "force of the holders on the cloth [N]"),
            )
        ),
        *(_mesh_arrays(spec.mesh) if spec.store_mesh else ()),
    )


_INSTANTS = {"instants_per_second": FRAMES_PER_SECOND}


def _mesh_arrays(side: int) -> tuple[ArrayLayout, ...]:
    """Return the arrays of a mesh of `side` vertices a side.

    Rest shape and triangles are the same for all samples of a dataset, and are there for each all the same: a row that
    repeats costs some bytes, an array without the dimension `sample` would be an exception in every reader.
    """
    vertices, triangles = side**2, 2 * (side - 1) ** 2
    return (
        ArrayLayout(
            "mesh",
            "float32",
            (FRAMES, vertices, 3),
            ("instant", "vertex", "xyz"),
            "positions of the vertices [m]; the floor is z = 0, the drag along x",
            fill=_NAN,
            per_sample=True,
            is_trajectory=True,
            attributes=_INSTANTS,
        ),
        ArrayLayout(
            "rest",
            "float32",
            (vertices, 2),
            ("vertex", "uv"),
            "the flat cloth [m]: along the held edge, and along the sheet up to it",
            fill=_NAN,
        ),
        ArrayLayout("triangles", "int32", (triangles, 3), ("triangle", "corner"), "vertices of the triangles", fill=-1),
    )


def describe(array: ArrayLayout) -> dict[str, Any]:
    """Return the attributes that the Zarr array carries."""
    attributes: dict[str, Any] = {"description": array.description, **array.attributes}
    if array.categories:
        attributes["categories"] = list(array.categories)
    return attributes
