"""Arrays of the datasets of cloth, of all its kinds and of scenes."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from stickslip_schemas.kinds.cloth.sensitivities import derivative_arrays
from stickslip_schemas.kinds.cloth.spec import ClipSpec, GroundTruth
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.spec.arrays import REGIONS, ArrayLayout, array
from stickslip_schemas.spec.names import Material

KERNELS = ("baseline", "x86-64-v3", "x86-64-v4")
"""Levels of the solver's kernels, in the order of the codes of the label `kernel`: add new ones at
the end.
"""


def scene_segments(sheets: Iterable[str], bodies: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the codes of the array `segmentation` of a scene."""
    return ("background", *sheets, *bodies, "holders")


def codes(name: str, names: tuple[str, ...]) -> ArrayLayout:
    """Return the label of an axis of names: a code each, in the order of `names`."""
    return array(name, f"code of the {name}", "int16", categories=tuple(map(str, names)))


def over_time(
    spec: ClipSpec,
    name: str,
    text: str,
    dtype: str = "float32",
    of: Mapping[str, int] | None = None,
    **more: Any,
) -> ArrayLayout:
    """Return a recorded array: a number, or an array of dimensions `of`, at each instant."""
    # Readers need the rate to know the time of an instant.
    attributes = {"instants_per_second": spec.instants_per_second, **more.pop("attributes", {})}
    return array(
        name,
        text,
        dtype,
        {"instant": spec.instants, **(of or {})},
        is_recorded=True,
        attributes=attributes,
        **more,
    )


PICTURE_SIZE = array(
    "picture_size",
    "width and height of the picture of the sample, in the upper left of its frames [px]",
    "int32",
    {"side": 2},
)
"""Label of a dataset whose viewpoints have several resolutions."""


def clip_arrays(spec: ClipSpec) -> tuple[ArrayLayout, ...]:
    """Return the arrays of clips and the labels of looks, which all kinds of cloth have."""
    # A clip shows some instants of the motion; the attribute says which.
    width, height = spec.frame_size
    pixels = {"frame": spec.frames, "y": height, "x": width}
    instants = {"instants": list(spec.shown_instants)}
    light = "azimuth and elevation of the lamp [degree], its power over the nominal"
    floor = (
        "albedo, roughness, metallic, specular and contrast of the marks of the floor, and its "
        "tint (rgb)"
    )
    return (
        array(
            "video",
            "sRGB clip",
            "uint8",
            pixels | {"rgb": 3},
            per_sample=True,
            is_clip=True,
            attributes=instants,
        ),
        *_ground_truth_arrays(spec, pixels),
        *((PICTURE_SIZE,) if spec.canvas else ()),
        *(
            codes(axis, spec.names(axis))
            for axis in ("texture", "viewpoint", "lighting", "substrate")
        ),
        array("light_seed", "seed of the lamp, the floor and the noise", "int32"),
        array("light", light, "float32", {"light": 3}),
        array("floor", floor, "float32", {"floor": 8}),
        array("creases", "strength of the creases that the renderer added", "float32"),
        array("frame_share", "share of the frame that is cloth, mean of the clip", "float32"),
        array("visible_share", "share of the cloth in sight, mean of the clip", "float32"),
        *(
            array(f"psnr_{name}", f"PSNR over {region} [dB], NaN: not measured", "float32")
            for name, region in REGIONS.items()
        ),
        array(
            "psnr_deviation",
            "standard deviations of the three PSNR [dB]",
            "float32",
            {"region": len(REGIONS)},
        ),
    )


def _ground_truth_arrays(spec: ClipSpec, pixels: dict[str, int]) -> tuple[ArrayLayout, ...]:
    """Return the arrays per pixel that the spec asks for.

    Textures share them, and each of their samples has them.
    """
    # Depth and normals are exact: they are computed, not rendered.
    segments = {"categories": list(spec.segments)}
    normals = "normals towards the camera, in its axes (right, down, forward); 0 where nothing is"
    flow = "motion of the visible point until the next frame of the clip [px], 0 in the last"
    arrays = (
        array(
            "depth",
            "depth along the optical axis [m], infinite where nothing is",
            "float32",
            pixels,
        ),
        array("segmentation", "code of the visible object", "uint8", pixels, attributes=segments),
        array("normals", normals, "float16", pixels | {"xyz": 3}),
        array(
            "uv",
            "place on the cloth, 0 to 1 along warp and weft, else NaN",
            "float16",
            pixels | {"uv": 2},
        ),
        array("flow", flow, "float16", pixels | {"xy": 2}),
    )
    return tuple(
        replace(each, per_sample=True)
        for each in arrays
        if GroundTruth(each.name) in spec.ground_truth
    )


def fabric_arrays(prefix: str = "") -> tuple[ArrayLayout, ...]:
    """Return the labels of the numbers of a fabric, whose names begin with a prefix."""
    # Numbers of the fabric after its factors, so that a network can learn them.
    rigidity = "plate rigidities along the warp, along the weft, and of twist [N m]"
    stiffness = "k0, k1, k2, k3 of [Wang et al. 2011] at no strain [N/m]"
    softening = "|b|/D0 of bending that softens, 1 over the card's softening; 0 if constant [m]"
    return (
        array(f"{prefix}areal_density", "mass per area [kg/m^2]"),
        array(f"{prefix}bending_rigidity", rigidity, of={"direction": 3}),
        array(f"{prefix}softening_length", softening),
        array(f"{prefix}stretching_stiffness", stiffness, of={"coefficient": 4}),
    )


CHECKS: Mapping[str, tuple[str, float | None]] = MappingProxyType(
    {
        "not_finite": ("coordinates that are not finite numbers", 0.0),
        "jumps": (
            "distance of bodies and holders from even motion in a step, over the step error",
            1.0,
        ),
        "unconverged": (
            "steps above the tolerance in the worst 500 steps, over those that the preset allows",
            1.0,
        ),
        "budget": (
            "most iterations in a second of the scene, or for a step, over the allowed ones",
            1.0,
        ),
        "crossings": ("pairs of triangles that cross in a frame, where cloth touches itself", 0.0),
        "contact_gain": (
            "work that bodies do on the motion against them, over the flow of energy, at its "
            "worst stretch",
            1e-3,
        ),
        "energy_gain": (
            "largest energy gained beyond the work of all forces, over the flow of energy",
            None,
        ),
        "stretch": ("largest principal stretch of a triangle", 1.25),
        "penetration": (
            "largest depth in a body beyond the sagitta of flat triangles [cells]",
            0.1,
        ),
        "passages": ("triangles that passed the core of a body", 0.0),
        "friction_error": (
            "relative error of the coefficient of friction with one body, surface or sheet, by "
            "the size of cells, in the worst stretch",
            0.03,
        ),
        "step_error": (
            "largest distance by which one step of the solver alone misplaces a vertex [mm]",
            10.0,
        ),
    }
)
"""Checks of the solver by name: the quantity, at its worst, and the limit of valid samples;
None: not judged.
"""


def _check(name: str, text: str, limit: float | None) -> ArrayLayout:
    # A check without a limit is recorded, and rejects nobody.
    if limit is None:
        return array(name, text)
    return array(name, f"{text}; at most {limit:g} if valid", attributes={"limit": limit})


def solver_arrays(spec: ClipSpec) -> tuple[ArrayLayout, ...]:
    """Return the labels of the solver and of its checks, which all kinds of cloth have."""
    return (
        codes("kernel", KERNELS),
        array("steps", "time steps of the solver", "int32"),
        array("unconverged_steps", "steps that stopped short of the tolerance", "int32"),
        array(
            "worst_residual",
            "largest residual force of a node in any step, over the weight of a node",
        ),
        *(_check(name, text, limit) for name, (text, limit) in CHECKS.items()),
        over_time(spec, "self_intersections", "pairs of triangles that cross", "int16"),
    )


STATES = ("open", "stick", "slip")
"""Names of the codes of the arrays of contact: add new ones at the end."""


def scene_arrays(spec: ClipSpec, scene: Scene) -> tuple[ArrayLayout, ...]:
    """Return the arrays of a dataset of a scene, without the arrays of clips and parameters."""
    # Labels of the scene as a whole, which are there only if the scene has their cause.
    bias = array(
        "bias", "what broke the symmetry: horizontal (x, y) over vertical gravity", of={"xy": 2}
    )
    rest = array("rest_time", "when all was at rest [s]; NaN where it was not")
    # Positions are by far the largest arrays, and may be left out.
    meshes: list[ArrayLayout] = []
    if spec.store_positions:
        for name in scene.sheets:
            meshes += _mesh(spec, scene, name)
        positions = {f"{name}.": _positions(spec, scene, name) for name in scene.sheets}
        meshes += derivative_arrays(spec, positions)
    labels: list[ArrayLayout] = []
    for name, sheet in scene.sheets.items():
        labels += fabric_arrays(f"{name}.")
        if sheet.start.type == "hung":
            labels.append(
                array(
                    f"{name}.tilt",
                    "lean of gravity along the normal as it came to hang, over gravity",
                )
            )
    return (
        array(
            "camera",
            "of the clip: fx, fy, cx, cy [px], rotation (rows), translation [m]",
            of={"camera": 16},
        ),
        *((bias,) if scene.bias else ()),
        *((rest,) if scene.end else ()),
        array(
            "least_distance",
            "of vertices and edges of cloth in contact, at the ends of all steps [m]",
        ),
        *labels,
        *solver_arrays(spec),
        *_tracks(spec, scene),
        *meshes,
    )


def parameter_label(scene: Scene, parameter: str) -> ArrayLayout:
    """Return the label of a parameter: a number with its unit, or the code of a fabric."""
    # Numbers have their unit in the description; fabrics are codes.
    document = scene.parameters[parameter]
    if isinstance(scene.default(parameter), float):
        description = document.description or "parameter of the scene"
        return array(parameter, f"{description} [{document.unit}]")
    return codes(parameter, (*Material, *scene.materials))


def _tracks(spec: ClipSpec, scene: Scene) -> Iterator[ArrayLayout]:
    """Yield forces and poses, in the order of names that their attributes give."""
    sheets = list(scene.sheets)
    bodies = list(scene.bodies)
    holders = [f"{sheet}.{holder}" for sheet, holder in scene.holders]
    pose = {"row": 3, "column": 4}

    # Forces are on sheets, from bodies first and then from sheets.
    partners = [*bodies, *sheets]
    yield over_time(
        spec,
        "contact_force",
        "force of bodies, then sheets, on each sheet [N]",
        of={"sheet": len(sheets), "other": len(partners), "xyz": 3},
        attributes={"sheets": sheets, "others": partners},
    )
    if bodies:
        yield over_time(
            spec,
            "body_pose",
            "x -> A x + b from a body's axes [m]",
            of={"body": len(bodies), **pose},
            attributes={"names": bodies},
        )
    if holders:
        by_holder = {"holder": len(holders)}
        names = {"names": holders}
        yield over_time(
            spec,
            "holder_force",
            "force of each holder on its sheet [N]",
            of={**by_holder, "xyz": 3},
            attributes=names,
        )
        yield over_time(
            spec,
            "holder_pose",
            "x -> A x + b from a holder's axes [m]",
            of={**by_holder, **pose},
            attributes=names,
        )
        yield over_time(
            spec, "grasped", "1 while a holder holds", "uint8", by_holder, attributes=names
        )


def _positions(spec: ClipSpec, scene: Scene, sheet: str) -> ArrayLayout:
    vertices, _ = scene.sheets[sheet].mesh.shape
    # Dimensions have the name of the sheet: sheets have different numbers of vertices.
    return over_time(
        spec,
        f"{sheet}.positions",
        "positions of the vertices [m]",
        of={f"{sheet}.vertex": vertices, "xyz": 3},
        per_sample=True,
        is_trajectory=True,
    )


def _mesh(spec: ClipSpec, scene: Scene, sheet: str) -> tuple[ArrayLayout, ...]:
    """Return the mesh of a sheet, its motion and its contact."""
    vertices, triangles = scene.sheets[sheet].mesh.shape
    by_vertex = {f"{sheet}.vertex": vertices}
    by_corner = {f"{sheet}.triangle": triangles, "corner": 3}
    return (
        _positions(spec, scene, sheet),
        over_time(
            spec,
            f"{sheet}.contact",
            "contact of each vertex",
            "uint8",
            by_vertex,
            attributes={"categories": STATES},
        ),
        array(
            f"{sheet}.rest",
            "the flat sheet (warp, weft) [m]",
            "float32",
            {**by_vertex, "uv": 2},
            is_recorded=True,
        ),
        array(
            f"{sheet}.triangles", "vertices of the triangles", "int32", by_corner, is_recorded=True
        ),
    )
