"""Scenes from a document of sheets, holders, bodies and their friction."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core._sim_core import sheet_count
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Friction, SelfContact
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes.family import SceneFamily, SceneParameter
from stickslip_sim_core.scenes.holders import Hang, Hanging, Holder, hung
from stickslip_sim_core.scenes.kind import IMPOSSIBLE_START, Kind, OnFrame, Outcome, Record
from stickslip_sim_core.scenes.parts import Document, Sheet, Thing, sheet, thing
from stickslip_sim_core.scenes.scene import ClothRun, Scene, cloth_kernel, fabric_labels
from stickslip_sim_core.scenes.sensitivities import positions_by

FrictionOfPairs = Mapping[tuple[str, str], Friction]
"""Friction by the names of a sheet and of another sheet or a body."""


class FamilyParameter(NamedTuple):
    """A number of a document that scenes of a family differ in."""

    places: Sequence[Sequence[str | int]]
    """Where the number is: names, and positions in lists. It is the same at all places."""
    low: float
    high: float
    unit: str = "1"


UPRIGHT = 1.0
"""Time in which gravity turns upright over a hung sheet after its bias ends [s]."""


def scene(
    document: Document, *, seed: int = 0, kernel: str | None = None, hang: Hang = hung
) -> Scene:
    """Return the scene of a document.

    The document is `Physics` of stickslip_schemas.scene, as JSON, with arrays in place of files.

    A run records these arrays besides the arrays of all scenes. Sheets, holders and bodies are in
    the order of their names.

    - `SHEET.positions`, `SHEET.rest`, `SHEET.triangles`, and `SHEET.contact` (frame, vertex): 0
      open, 1 stick, 2 slip, at the vertex nearest to each point that touches
    - `contact_force` (frame, sheet, other, 3) [N]: on each sheet, by each body and then by each
      sheet
    - `holder_force` (frame, holder, 3) [N], `holder_pose` (frame, holder, 3, 4), `grasped` (frame,
      holder), and `holder_box` (holder, 3) [m], if the scene has holders
    - `body_pose` (frame, body, 3, 4), if the scene has bodies: x -> A x + b from the body's own
      axes
    - `BODY.rest` and `BODY.triangles` of a body of triangles, and `BODY.vertices` (frame, vertex,
      3) [m] if it deforms

    `seed` draws the biases that break the symmetry of the scene. For `kernel`, see `Cloth`. `hang`
    lets sheets hang.

    Raises:
        ValueError: A value breaks its rule. The message begins with the place of the value.
    """
    friction = _friction(document)
    sheets = _sheets(document, seed, kernel, hang)
    things = _things(document, sheets, friction)
    held = _held(sheets)
    gravity = _Gravity(document, sheets, seed)
    # Surfaces move as `Surface` objects, so `motion` and `poses` have rigid bodies only.
    rigid = [body.rigid for body in things if body.rigid is not None]
    rigid_poses = [body.pose for body in things if body.rigid is not None]
    calm = document["calm"]
    return Scene(
        mesh=meshes.together(*(part.mesh for part in sheets)),
        fabrics=[part.fabric for part in sheets],
        preset=preset_named(document["preset"]),
        start=np.concatenate([part.start for part in sheets]),
        motion=lambda time: (gravity.at(time), [body_at(time) for body_at in rigid]),
        poses=lambda times: np.swapaxes(
            np.reshape([pose(times) for pose in rigid_poses], (-1, len(times), 3, 4)), 0, 1
        ),
        holders=held.holders,
        self_contact=_touch(document, sheets, friction),
        surfaces=[body.surface for body in things if body.surface is not None],
        damping=lambda time: calm["rate"] if calm is not None and time <= calm["until"] else 0.0,
        frames=_frames(document),
        frame_rate=document["frame_rate"],
        still_from=None if document["end"] is None else _last_change(gravity, sheets, things),
        forces=_Forces(sheets, things, held.holders),
        tracks=_tracks(things, held),
        record={"holder_box": np.stack(held.boxes)} if held.boxes else {},
        arrays=lambda run: _arrays(run, sheets, things),
        labels=lambda run: _labels(run, document, sheets, gravity.bias),
        kernel=kernel,
        others=[
            *(f"bodies.{body.name}" for body in things if body.rigid is not None),
            *(f"bodies.{body.name}" for body in things if body.surface is not None),
            *(f"sheets.{part.name}" for part in sheets),
        ],
        reason=_hanging_fault(sheets),
        hangings=_hangings(sheets),
    )


def _sheets(document: Document, seed: int, kernel: str | None, hang: Hang) -> list[Sheet]:
    """Return the sheets in the order of their names."""
    sheets = []
    for name, described in sorted(document["sheets"].items()):
        part = sheet(
            name,
            described,
            document["materials"],
            gravity=document["gravity"],
            seed=seed,
            kernel=kernel,
            hang=hang,
        )
        # The solver counts every connected piece as a sheet. Two pieces under one name would shift
        # the numbers of all later sheets.
        if sheet_count(part.mesh.rest, part.mesh.triangles) != 1:
            raise ValueError(f"sheets.{name}.mesh: must hang together in one piece")
        sheets.append(part)
    return sheets


def _things(document: Document, sheets: Sequence[Sheet], friction: FrictionOfPairs) -> list[Thing]:
    """Return the bodies in the order of their names, with their friction by sheet."""
    cell = max(part.mesh.spacing for part in sheets)
    things = []
    for name, body in sorted(document["bodies"].items()):
        by_sheet = [friction[part.name, name] for part in sheets]
        things.append(thing(name, body, by_sheet, cell=cell))
    return things


@dataclass(frozen=True)
class _Held:
    """The holders of all sheets, in the order of sheets and of their names."""

    holders: Sequence[Holder]
    """Their vertices are numbered through all sheets."""

    poses: Sequence[Callable[[float], Floats]]
    boxes: Sequence[Floats]


def _held(sheets: Sequence[Sheet]) -> _Held:
    holders: list[Holder] = []
    poses: list[Callable[[float], Floats]] = []
    boxes: list[Floats] = []
    # The solver numbers the vertices of all sheets together, one sheet after the other.
    for part, begin in zip(sheets, _vertex_begins(sheets), strict=False):
        for holder in part.holders.values():
            holders.append(replace(holder, vertices=holder.vertices + begin))
        poses += part.tracks.values()
        boxes += part.boxes.values()
    return _Held(holders, poses, boxes)


def _vertex_begins(sheets: Sequence[Sheet]) -> NDArray[np.int64]:
    """Return the number of the first vertex of each sheet, and at the end that of all vertices."""
    return np.cumsum([0, *(len(part.start) for part in sheets)])


def _frames(document: Document) -> int:
    """Return the number of frames up to the end, which may come earlier."""
    end = document["end"]
    length: float = document["duration"] if end is None else end["at_most"]
    # The factor keeps the last frame if rounding puts it just after the end of the scene.
    return int(length * document["frame_rate"] * (1.0 + 1e-12)) + 1


def _last_change(gravity: "_Gravity", sheets: Sequence[Sheet], things: Sequence[Thing]) -> float:
    """Return the time of the last motion or change of gravity [s].

    Cloth that is still before may yet be moved, so the scene must not end there.
    """
    of_parts = [*(part.last for part in sheets), *(body.last for body in things)]
    return max([0.0, gravity.last, *of_parts])


def _tracks(things: Sequence[Thing], held: _Held) -> dict[str, Callable[[float], NDArray[Any]]]:
    """Return the recorded arrays of bodies and holders at the time of each frame, by name."""
    tracks: dict[str, Callable[[float], NDArray[Any]]] = {
        f"{body.name}.vertices": body.surface.at
        for body in things
        if body.surface is not None and body.deforms
    }
    if things:
        tracks["body_pose"] = lambda time: np.stack([body.pose(time) for body in things])
    if held.holders:
        tracks["holder_pose"] = lambda time: np.stack([pose(time) for pose in held.poses])
        tracks["grasped"] = lambda time: np.array(
            [holder.holds(time) for holder in held.holders], np.uint8
        )
    return tracks


def _hangings(sheets: Sequence[Sheet]) -> list[Hanging]:
    """Return the sheets that hang at the start."""
    hangings = []
    begins = _vertex_begins(sheets)
    for number, part in enumerate(sheets):
        if part.hung is not None:
            begin = int(begins[number])
            hangings.append(Hanging(number, begin, part.mesh, part.fabric, part.hung))
    return hangings


def _hanging_fault(sheets: Sequence[Sheet]) -> str:
    """Return why a hung sheet has no stable start, or an empty text if all have one."""
    for part in sheets:
        if part.hung is not None and part.hung.reason:
            return part.hung.reason
    return ""


def _friction(document: Document) -> dict[tuple[str, str], Friction]:
    """Return the friction of each sheet with each sheet and body."""
    pairs = {frozenset(pair["between"]): _friction_of(pair) for pair in document["friction"]}
    default = float(document["default_friction"] or 0.0)
    friction = {}
    for names in product(document["sheets"], (*document["sheets"], *document["bodies"])):
        # A pair has no order. A sheet with itself is a set of a single name.
        friction[names] = pairs.get(frozenset(names), Friction(default, default))
    return friction


def _friction_of(pair: Document) -> Friction:
    """Return the friction of a pair of the document, which has `mu`, or both coefficients."""
    mu = pair.get("mu")
    if mu is not None:
        return Friction(float(mu), float(mu))
    return Friction(float(pair["kinetic"]), float(pair["static"]))


def _touch(
    document: Document, sheets: Sequence[Sheet], friction: FrictionOfPairs
) -> SelfContact | None:
    """Return the contact of cloth with cloth, or None if the only sheet has no self-contact."""
    names = [part.name for part in sheets]
    # `SelfContact` is on or off for all sheets together.
    without = [name for name in names if not document["sheets"][name]["self_contact"]]
    if without and len(sheets) > 1:
        raise ValueError(
            f"sheets.{without[0]}.self_contact: must be true in a scene of several sheets, "
            "got false"
        )
    if without:
        return None
    by_names = np.array([[friction[name, other] for other in names] for name in names], float)
    return SelfContact(
        by_names[..., 0],
        [part.thickness for part in sheets],
        document["bearing"],
        mu_static=by_names[..., 1],
    )


class _Gravity:
    """Gravity over time, tilted by the bias of the scene and the biases of hung sheets."""

    def __init__(self, document: Document, sheets: Sequence[Sheet], seed: int) -> None:
        self._down = np.tile(
            np.array(document["gravity"], float), (sum(len(sheet.start) for sheet in sheets), 1)
        )
        self._size = float(np.linalg.norm(document["gravity"]))
        self._tilted = self._down
        self._until = -np.inf
        self.bias = np.zeros(2)
        # Perfect symmetry would leave the choice of a side to rounding.
        if document["bias"] is not None:
            size = document["bias"]["size"]
            self._until = document["bias"]["until"]
            self.bias = np.random.default_rng(seed).uniform(-size, size, 2)
            self._tilted = self._down + self._size * np.append(self.bias, 0.0)
        # Vertices, tilt and end of the bias of each sheet that hangs at the start.
        self._hung: list[tuple[slice, Floats, float]] = []
        begin = 0
        for part in sheets:
            end = begin + len(part.start)
            if part.hung is not None:
                until = document["sheets"][part.name]["start"]["bias_until"]
                self._hung.append((slice(begin, end), part.hung.tilt, until))
            begin = end
        self.last = max([0.0, self._until, *(until + UPRIGHT for _, _, until in self._hung)])
        """Time of the last change of gravity [s]."""

    def at(self, time: float) -> Floats:
        """Return the acceleration of each vertex at a time [s]: (V, 3) [m/s^2]."""
        acceleration = self._tilted if time < self._until else self._down
        # The loop below adds to the array, which must not change for later times.
        if self._hung:
            acceleration = acceleration.copy()
        for vertices, tilt, until in self._hung:
            # The bias of a hung sheet fades within `UPRIGHT` seconds after its end.
            upright = min(max(time - until, 0.0) / UPRIGHT, 1.0)
            acceleration[vertices] += tilt * self._size * (1.0 - upright)
        return acceleration


class _Forces:
    """Forces and contacts at a frame, by sheets, bodies and holders."""

    def __init__(
        self, sheets: Sequence[Sheet], things: Sequence[Thing], holders: Sequence[Any]
    ) -> None:
        self._names = [sheet.name for sheet in sheets]
        self._sheets, self._things, self._holders = len(sheets), len(things), holders
        rigid = [number for number, thing in enumerate(things) if thing.rigid is not None]
        surfaces = [number for number, thing in enumerate(things) if thing.surface is not None]
        # The solver counts surfaces after rigid bodies, and a scene has both in order of names.
        self._partners = np.array([*rigid, *surfaces], dtype=np.intp)
        # The owner of a vertex is a number along the axis of `force`: bodies first, then sheets.
        # The solver's vertices are those of all sheets, and then those of all surfaces.
        sizes = [len(thing.surface.at(0.0)) for thing in things if thing.surface is not None]
        owners = [
            self._things
            + np.repeat(np.arange(self._sheets), [len(sheet.start) for sheet in sheets])
        ]
        self._owner = np.concatenate([*owners, np.repeat(np.array(surfaces, dtype=np.intp), sizes)])
        self._ends = np.cumsum([len(sheet.start) for sheet in sheets])

    def __call__(self, cloth: Cloth) -> Record:
        """Return `contact_force`, `SHEET.contact` and `holder_force`.

        Nothing touches before the first step.
        """
        # `force` is square so that one loop adds both forces of a pair. The rows of bodies are cut
        # off at the end.
        vertices = len(cloth.masses)
        force = np.zeros((self._things + self._sheets,) * 2 + (3,))
        state = np.zeros(vertices, np.uint8)
        pulls = np.zeros((len(self._holders), 3))
        if cloth.total.steps:
            reactions = cloth.reactions
            contacts = cloth.contacts
            pairs = cloth.pair_forces
            # The reaction of a held vertex is the force of its holder, and no contact.
            held = np.isin(np.arange(vertices), cloth.held)
            touching = np.flatnonzero((contacts >= 0) & ~held)
            opposites = cloth.opposites
            across = cloth.opposite_forces
            pressed = np.flatnonzero(opposites >= 0)
            # Several vertices add to the same entry, which `force[...] +=` would count once.
            np.add.at(
                force,
                (self._owner[touching], self._partners[contacts[touching]]),
                reactions[touching] - across[touching],
            )
            np.add.at(
                force,
                (self._owner[pressed], self._partners[opposites[pressed]]),
                across[pressed],
            )
            state[touching] = np.where(cloth.sliding[touching], 2, 1)
            owner = self._owner[pairs.vertices]
            # The four nodes of a pair belong to its two sides: the first node is on one side, and
            # the last node on the other.
            first = owner[:, 0]
            last = owner[:, 3]
            nearest = _nearest(pairs.weights)
            for corner in range(4):
                owner_of_corner = owner[:, corner]
                pull = pairs.weights[:, corner, None] * pairs.forces
                np.add.at(
                    force, (owner_of_corner, np.where(owner_of_corner == first, last, first)), pull
                )
                # Only vertices of cloth have a state. Slip (2) in one pair outweighs sticking (1)
                # in another.
                here = (pairs.vertices[:, corner] < vertices) & nearest[:, corner]
                np.maximum.at(
                    state,
                    pairs.vertices[here, corner],
                    np.where(pairs.sliding[here], 2, 1).astype(np.uint8),
                )
            # A holder that has let go exerts no force.
            for number, holder in enumerate(self._holders):
                if held[holder.vertices].all():
                    pulls[number] = reactions[holder.vertices].sum(axis=0)
        arrays = {"contact_force": force[self._things :]}
        arrays |= {
            f"{name}.contact": states
            for name, states in zip(self._names, np.split(state, self._ends[:-1]), strict=True)
        }
        return arrays | ({"holder_force": pulls} if len(self._holders) else {})


def _nearest(weights: Floats) -> NDArray[np.bool_]:
    """Return which nodes of pairs (P, 4) are nearest to the points that touch: (P, 4).

    The weights of a pair are positive on one side and negative on the other. On each side the node
    with the largest weight is the nearest, or several with the same. The others may be a cell away.
    """
    nearest = np.zeros(weights.shape, np.bool_)
    for side in (np.maximum(weights, 0.0), np.maximum(-weights, 0.0)):
        nearest |= (side > 0.0) & (side == side.max(axis=1, keepdims=True))
    return nearest


def _arrays(run: ClothRun, sheets: Sequence[Sheet], things: Sequence[Thing]) -> Record:
    arrays: dict[str, Any] = {}
    inner_begins = _vertex_begins(sheets)[1:-1]
    for part, positions in zip(sheets, np.split(run.positions, inner_begins, axis=1), strict=True):
        arrays[f"{part.name}.positions"] = positions
        arrays[f"{part.name}.rest"] = part.mesh.rest
        arrays[f"{part.name}.triangles"] = part.mesh.triangles
    for name, derivatives in positions_by(run.sensitivities).items():
        of_sheets = np.split(derivatives, inner_begins, axis=1)
        for part, of_sheet in zip(sheets, of_sheets, strict=True):
            arrays[f"{part.name}.{name}"] = of_sheet
    for body in things:
        if body.surface is not None:
            arrays[f"{body.name}.rest"] = body.rest
            arrays[f"{body.name}.triangles"] = np.asarray(body.surface.triangles)
    return arrays


def _labels(
    run: ClothRun, document: Document, sheets: Sequence[Sheet], bias: Floats
) -> dict[str, Any]:
    labels: dict[str, Any] = {"least_distance": float(run.least_distance)}
    for cloth_sheet in sheets:
        labels |= fabric_labels(cloth_sheet.fabric, f"{cloth_sheet.name}.")
        if cloth_sheet.hung is not None:
            labels[f"{cloth_sheet.name}.tilt"] = cloth_sheet.hung.side * cloth_sheet.hung.bias
    if document["bias"] is not None:
        labels["bias"] = bias.tolist()
    if document["end"] is not None:
        labels["rest_time"] = run.rest_time
    return labels


def family(
    document: Document,
    parameters: Mapping[str, FamilyParameter],
    *,
    seed: int = 0,
    kernel: str | None = None,
) -> SceneFamily:
    """Return the scenes of a document that differ in the numbers at some places.

    Args:
        document: As of `scene`.
        parameters: For each name the places in the document of one number, and its range.
        seed: As of `scene`.
        kernel: As of `scene`.
    """
    known = {}
    for name, (places, low, high, unit) in parameters.items():
        known[name] = SceneParameter(float(_value_at(document, places[0])), low, high, unit)

    def make(values: Mapping[str, float], hang: Hang) -> Scene:
        changed = document
        for name, value in values.items():
            for place in parameters[name].places:
                changed = _with_value(changed, place, value)
        return scene(changed, seed=seed, kernel=kernel, hang=hang)

    return SceneFamily(known, make)


def _value_at(document: Any, place: Sequence[str | int]) -> Any:
    for step in place:
        document = document[step]
    return document


def _with_value(document: Any, place: Sequence[str | int], value: float) -> Any:
    """Return a document with another value at a place; it shares all else with the first one."""
    if not place:
        return value
    step, *further = place
    copy: Any = dict(document) if isinstance(document, Mapping) else list(document)
    copy[step] = _with_value(document[step], further, value)
    return copy


def _simulated(scene_and_seed: Mapping[str, Any], on_frame: OnFrame | None) -> Outcome:
    """Return the outcome of a simulation.

    Values that do not fit together are a reason to reject the simulation before it starts. A later
    error is a bug, and the caller gets it.
    """
    asked = scene_and_seed.get("sensitivities", {})
    parameters = {name: FamilyParameter(**places) for name, places in asked.items()}
    try:
        scenes = family(scene_and_seed["scene"], parameters, seed=scene_and_seed["seed"])
        simulated_scene = scenes.differentiated(tuple(parameters))
    except ValueError as error:
        return Outcome(reason=str(error), code=IMPOSSIBLE_START)
    return simulated_scene.outcome(on_frame)


KIND = Kind(
    lambda simulations, on_frame: [_simulated(simulation, on_frame) for simulation in simulations],
    "stickslip_sim_core.cloth",
    kernel=cloth_kernel,
)
