"""Parts of a scene, from its document: sheets and their starts, motions, holders and bodies.

The document is `Physics` of stickslip_schemas.scene, as JSON, with arrays in place of files.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import (
    Body,
    Friction,
    Surface,
    box,
    capsule,
    cylinder,
    default_rounding,
    plane,
    sphere,
)
from stickslip_sim_core.cloth.fabrics import Fabric, fabric, fabric_of_card
from stickslip_sim_core.scenes.holders import ALWAYS, Hang, Holder, Hung, hung
from stickslip_sim_core.scenes.motions import Keyframes, MovingMesh, RigidMotion, Spin, rotation

Document = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Sheet:
    """One piece of cloth at its start."""

    name: str
    mesh: meshes.Mesh
    fabric: Fabric
    thickness: float
    start: Floats
    """Positions of the vertices at the start: (V, 3) [m]."""

    hung: Hung | None
    """Hung shape, if the sheet hangs at the start."""

    holders: Mapping[str, Holder]
    """Holders by name. They count the vertices of this sheet alone."""

    tracks: Mapping[str, Callable[[ArrayLike], Floats]]
    """Poses of the holders by name, from the holder's axes to the world: (3, 4).

    The axes of a holder are the warp, the weft and the normal of the flat sheet.
    """

    boxes: Mapping[str, Floats]
    """Sides of the box around the held vertices, by holder and in its axes: (3,) [m].

    They are NaN for the holder of a rim.
    """

    last: float
    """Time after which no holder moves, takes hold or lets go any more [s]."""


def sheet(
    name: str,
    document: Document,
    materials: Document,
    *,
    gravity: ArrayLike,
    seed: int,
    kernel: str | None,
    hang: Hang = hung,
) -> Sheet:
    """Return a sheet of a document. `materials` are its custom fabrics.

    Hung cloth hangs under `gravity` (3,) [m/s^2], and `seed` draws its tilt. `hang` lets it hang.

    Raises:
        ValueError: A value breaks its rule. The message begins with the place of the value.
    """
    place = f"sheets.{name}"
    mesh, file_positions = _mesh(document["mesh"])
    cloth_fabric = _fabric(document, materials)
    turn = rotation(document["turn"])
    local = _local_start(document["start"], mesh, file_positions, place)
    start = local @ turn.T + np.array(document["origin"], float)
    grips = _grips(document["holders"], mesh, start, turn, place)
    # Holders take the hung cloth at its flat positions: `hung` does not move held vertices.
    hanging = None
    if document["start"]["type"] == "hung":
        hanging = hang(
            mesh,
            cloth_fabric,
            start,
            np.flatnonzero(grips.held),
            normal=turn[:, 2],
            seed=seed,
            gravity=gravity,
            kernel=kernel,
        )
        start = hanging.positions
    return Sheet(
        name,
        mesh,
        cloth_fabric,
        document["thickness"],
        start,
        hanging,
        grips.holders,
        grips.tracks,
        grips.boxes,
        grips.last,
    )


def _fabric(document: Document, materials: Document) -> Fabric:
    """Return the fabric of a sheet: a custom one of `materials`, or a built-in one."""
    name = document["material"]
    card = materials.get(name)
    whole = fabric(name) if card is None else fabric_of_card(name, card)
    return whole.scaled(**document["factors"])


def _local_start(
    start: Document, mesh: meshes.Mesh, file_positions: Floats | None, place: str
) -> Floats:
    """Return the positions of a sheet in its own axes: (V, 3) [m].

    The document turns and moves them afterwards. `file_positions` (V, 3) [m] are those of the file
    of the mesh.
    """
    flat = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    if start["type"] == "stretched":
        flat[:, :2] = (1.0 + np.array(start["strain"])) * mesh.rest
    if start["type"] != "file":
        return flat
    # Positions come from the file of the start, or else from the file of the mesh.
    positions = file_positions if start["file"] is None else start["file"]["positions"]
    if positions is None or positions.shape != flat.shape:
        raise ValueError(f"{place}.start.file: must have {len(flat)} vertices, as the mesh has")
    return positions


@dataclass(eq=False)
class _Grips:
    """The holders of a sheet, with the attributes of `Sheet` of the same names."""

    held: NDArray[np.bool_]
    """Whether a holder holds a vertex: (V,)."""

    last: float = 0.0
    holders: dict[str, Holder] = field(default_factory=dict)
    tracks: dict[str, Callable[[ArrayLike], Floats]] = field(default_factory=dict)
    boxes: dict[str, Floats] = field(default_factory=dict)


def _grips(
    documents: Document, mesh: meshes.Mesh, start: Floats, turn: Floats, place: str
) -> _Grips:
    """Return the holders of a sheet that starts at `start` (V, 3) [m] with axes `turn` (3, 3)."""
    grips = _Grips(np.zeros(len(start), dtype=bool))
    # In the order of names, so that results do not depend on the order in the document.
    for name, holder in sorted(documents.items()):
        held = _held(mesh, holder, f"{place}.holders.{name}")
        if (held & grips.held).any():
            raise ValueError(f"{place}.holders.{name}: must not hold what another holder holds")
        grips.held |= held
        # A holder turns about the middle of its vertices, unless the document names a point.
        middle = start[held].mean(axis=0)
        motion = rigid_motion(holder["motion"], middle)
        grasp = ALWAYS if holder["grasp"] is None else (holder["grasp"][0], holder["grasp"][1])
        grips.holders[name] = Holder(np.flatnonzero(held), motion.pose, grasp)
        grips.tracks[name] = _carried(motion, turn, middle)
        sides = np.ptp((start[held] - middle) @ turn, axis=0)
        grips.boxes[name] = np.full(3, np.nan) if holder["rim"] else sides
        changes = [instant for instant in grasp if np.isfinite(instant)]
        grips.last = max([grips.last, motion.last, *changes])
    return grips


def _mesh(document: Document) -> tuple[meshes.Mesh, Floats | None]:
    """Return the mesh of a sheet, and its positions if a file has them."""
    if document["type"] == "grid":
        return meshes.grid(*document["size"], *document["cells"]), None
    if document["type"] == "unstructured":
        return meshes.unstructured(
            document["size"][0], document["size"][1], document["spacing"], document["seed"]
        ), None
    file = document["file"]
    return meshes.Mesh(file["rest"], np.asarray(file["triangles"], np.int32)), file["positions"]


def _held(mesh: meshes.Mesh, holder: Document, place: str) -> NDArray[np.bool_]:
    """Return for each vertex whether a holder holds it: (V,)."""
    # The slack catches vertices on an edge in spite of rounding.
    rest = mesh.rest
    low = rest.min(axis=0)
    high = rest.max(axis=0)
    slack = 1e-9 * float((high - low).max())
    held = np.zeros(len(rest), dtype=bool)
    if holder["vertices"] is not None:
        if max(holder["vertices"]) >= len(rest):
            raise ValueError(
                f"{place}.vertices: must be below {len(rest)}, got {max(holder['vertices'])}"
            )
        held[list(holder["vertices"])] = True
    elif holder["rim"]:
        held[mesh.rim] = True
    elif holder["edge"] is not None:
        axis, at = {"left": (0, low), "right": (0, high), "bottom": (1, low), "top": (1, high)}[
            holder["edge"]
        ]
        held[:] = np.abs(rest[:, axis] - at[axis]) <= slack
    else:
        held[:] = (
            (rest >= np.array(holder["low"]) - slack) & (rest <= np.array(holder["high"]) + slack)
        ).all(axis=1)
        if not held.any():
            raise ValueError(
                f"{place}: must hold a vertex, and none is in {holder['low']} to "
                f"{holder['high']} [m]"
            )
    return held


def rigid_motion(document: Document | None, middle: Floats) -> RigidMotion:
    """Return a motion of a document.

    Turns are about `middle` (3,) [m] if the document names no point.
    """
    # A part without a motion stays in place.
    if document is None:
        return Keyframes([0.0], np.zeros((1, 3)), np.zeros((1, 3)))
    about = middle if document["about"] is None else np.array(document["about"], float)
    if document["spin"] is not None:
        spin = document["spin"]
        return Spin(spin["axis"], spin["speed"], spin["begin"], spin["ramp"], about)
    if document["path"] is not None:
        times, moves, turns = (document["path"][name] for name in ("time", "move", "turn"))
    else:
        times, moves, turns = (
            np.array([key[name] for key in document["keys"]]) for name in ("time", "move", "turn")
        )
    return Keyframes(
        times,
        moves,
        turns,
        about,
        linear=document["interpolation"] == "linear",
        ramp=document["ramp"],
    )


def _carried(motion: RigidMotion, turn: Floats, origin: Floats) -> Callable[[ArrayLike], Floats]:
    """Return a function of times [s] for the pose ([T,] 3, 4) of a part that moves.

    The part starts with axes `turn` (3, 3) at `origin` (3,) [m].
    """

    def at(time: ArrayLike) -> Floats:
        R, shift = np.split(motion.pose(time), [3], axis=-1)
        return np.concatenate([R @ turn, (R @ origin)[..., None] + shift], axis=-1)

    return at


@dataclass(frozen=True, eq=False)
class Thing:
    """A body: rigid, or a surface of triangles."""

    name: str
    pose: Callable[[ArrayLike], Floats]
    """Function of a time or times [s] for the pose ([T,] 3, 4), from the body to the world."""

    last: float
    """Time at which its motion ends [s]."""

    rigid: Callable[[float], Body] | None = None
    surface: Surface | None = None

    rest: Floats | None = None
    """Vertices of a surface at the first frame of its file: (N, 3) [m]."""

    deforms: bool = False
    """Whether the vertices of a surface move relative to its axes."""


def thing(name: str, document: Document, friction: Sequence[Friction], *, cell: float) -> Thing:
    """Return a body of a document.

    `friction` is that with each sheet. `cell` is the largest side of a cell of a
    sheet [m].

    Raises:
        ValueError: A value breaks its rule. The message begins with the place of the value.
    """
    mu = [of_sheet.kinetic for of_sheet in friction]
    resting = [of_sheet.static for of_sheet in friction]
    mu_static = None if resting == mu else resting
    if document["type"] == "plane":
        still = plane(mu, normal=document["normal"], origin=document["origin"])
        still = _with_static_friction(still, mu_static)
        return Thing(
            name,
            lambda time: np.broadcast_to(still.pose, (*np.shape(time), 3, 4)),
            0.0,
            lambda _time: still,
        )
    if document["type"] == "mesh":
        return _surface(name, document, mu, mu_static)
    origin = np.array(document["origin"], float)
    motion = rigid_motion(document["motion"], origin)
    pose = _carried(motion, rotation(document["turn"]), origin)

    rounding = document.get("rounding")
    if document["type"] == "box" and rounding is None:
        rounding = default_rounding(document["size"], cell)

    # Only the pose changes with time, so each shape takes it when the solver needs the body.
    make_body: Callable[..., Body] = {
        "sphere": lambda **placed: sphere(mu, document["radius"], **placed),
        "cylinder": lambda **placed: cylinder(mu, document["radius"], **placed),
        "capsule": lambda **placed: capsule(mu, document["radius"], document["length"], **placed),
        "box": lambda **placed: box(mu, document["size"], rounding=rounding, **placed),
    }[document["type"]]

    def rigid(time: float) -> Body:
        now = pose(time)
        return _with_static_friction(make_body(origin=now[:, 3], rotation=now[:, :3]), mu_static)

    return Thing(name, pose, motion.last, rigid=rigid)


def _with_static_friction(body: Body, mu_static: Sequence[float] | None) -> Body:
    """Return a body with other friction at rest; None is that of sliding."""
    return body if mu_static is None else replace(body, mu_static=mu_static)


def _surface(
    name: str, document: Document, mu: Sequence[float], mu_static: Sequence[float] | None
) -> Thing:
    # Errors of the mesh and of the surface do not have the name of the body, so add it.
    try:
        file = document["file"]
        # A file has the vertices of every frame, or the bones and weights of a skin.
        skin = {name: file[name] for name in ("rest", "weights") if name in file}
        frames = file["bones" if skin else "positions"]
        mesh = MovingMesh(
            file["triangles"], file["times"], frames, **skin, strength=document["strength"]
        )
        motion = rigid_motion(document["motion"], mesh.at(0.0).mean(axis=0))

        # The motion of the document adds to the motion of the file.
        def at(time: float) -> Floats:
            if document["motion"] is None:
                return mesh.at(time)
            pose = motion.pose(time)
            return np.asarray(mesh.at(time) @ pose[:, :3].T + pose[:, 3])

        surface = Surface(mesh.triangles, at, list(mu), document["thickness"], mu_static=mu_static)
    except ValueError as error:
        raise ValueError(f"bodies.{name}: {error}") from error
    last = max(motion.last, mesh.last)
    return Thing(
        name, motion.pose, last, surface=surface, rest=mesh.at(0.0), deforms=mesh.last > 0.0
    )
