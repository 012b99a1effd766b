"""Arrays of the datasets of scenes: they follow from the document."""

from typing import Any

from stickslip_schemas.kinds.cloth.arrays import codes, fabric_arrays, over_time, solver_arrays
from stickslip_schemas.kinds.cloth.spec import ClipSpec
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.spec.arrays import ArrayLayout, array
from stickslip_schemas.spec.fabrics import Material

STATES = ("open", "stick", "slip")
"""Names of the codes of the arrays of contact: add new ones at the end."""


def scene_arrays(spec: ClipSpec, scene: Scene) -> tuple[ArrayLayout, ...]:
    """Return the arrays of a dataset of a scene, without those of clips and parameters."""
    bias = array("bias", "what broke the symmetry: horizontal (x, y) over vertical gravity", of={"xy": 2})
    rest = array("rest_time", "when all was at rest [s]; NaN where it was not")
    labels: list[ArrayLayout] = []
    for name, sheet in scene.sheets.items():
        labels += fabric_arrays(f"{name}.")
        if sheet.start.type == "hung":
            labels.append(array(f"{name}.tilt", "lean of gravity along the normal as it came to hang, over gravity"))
    return (
        array("camera", "of the clip: fx, fy, cx, cy [px], rotation (rows), translation [m]", of={"camera": 16}),
        *((bias,) if scene.bias else ()),
        *((rest,) if scene.end else ()),
        array("least_distance", "of vertices and edges of cloth in contact, at the ends of all steps [m]"),
        *labels,
        *solver_arrays(spec),
        *_tracks(spec, scene),
        *(each for name in scene.sheets for each in _mesh(spec, scene, name) if spec.store_positions),
    )


def parameter_label(scene: Scene, parameter: str) -> ArrayLayout:
    """Return the label of a parameter: a number with its unit, or the code of a fabric."""
    given = scene.parameters[parameter]
    if isinstance(scene.default(parameter), float):
        return array(parameter, f"{given.description or 'parameter of the scene'} [{given.unit}]")
    return codes(parameter, (*Material, *scene.materials))


def _tracks(spec: ClipSpec, scene: Scene) -> tuple[ArrayLayout, ...]:
    """Return forces and poses, in the order of names that their attributes give."""
    sheets, bodies, holders = list(scene.sheets), list(scene.bodies), [f"{a}.{b}" for a, b in scene.holders]
    others = [*bodies, *sheets]
    by = {"sheet": len(sheets), "other": len(others), "xyz": 3}
    held, pose = {"holder": len(holders)}, {"row": 3, "column": 4}
    on = {"sheets": sheets, "others": others}
    of_bodies = over_time(
        spec,
        "body_pose",
        "x -> A x + b from a body's axes [m]",
        of={"body": len(bodies), **pose},
        attributes={"names": bodies},
    )
    said: dict[str, Any] = {"attributes": {"names": holders}}
    of_holders = (
        over_time(spec, "holder_force", "force of each holder on its sheet [N]", of={**held, "xyz": 3}, **said),
        over_time(spec, "holder_pose", "x -> A x + b from a holder's axes [m]", of={**held, **pose}, **said),
        over_time(spec, "grasped", "1 while a holder holds", "uint8", held, **said),
    )
    return (
        over_time(spec, "contact_force", "force of bodies, then sheets, on each sheet [N]", of=by, attributes=on),
        *((of_bodies,) if bodies else ()),
        *(of_holders if holders else ()),
    )


def _mesh(spec: ClipSpec, scene: Scene, sheet: str) -> tuple[ArrayLayout, ...]:
    vertices, triangles = scene.sheets[sheet].mesh.shape
    vertex = {f"{sheet}.vertex": vertices}
    corners = {f"{sheet}.triangle": triangles, "corner": 3}
    return (
        over_time(
            spec,
            f"{sheet}.positions",
            "positions of the vertices [m]",
            of={**vertex, "xyz": 3},
            per_sample=True,
            is_trajectory=True,
        ),
        over_time(
            spec, f"{sheet}.contact", "contact of each vertex", "uint8", vertex, attributes={"categories": STATES}
        ),
        array(f"{sheet}.rest", "the flat sheet (warp, weft) [m]", "float32", {**vertex, "uv": 2}, is_recorded=True),
        array(f"{sheet}.triangles", "vertices of the triangles", "int32", corners, is_recorded=True),
    )
