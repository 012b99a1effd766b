"""A scene of cloth that is data: its things, their motions, and its parameters."""

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from itertools import combinations, product
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    JsonValue,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from stickslip_schemas.base import Sha256, Stage, artifact_digest
from stickslip_schemas.kinds.cloth import fabric_axes
from stickslip_schemas.kinds.cloth.arrays import (
    clip_arrays,
    parameter_label,
    scene_arrays,
    scene_segments,
    solver_arrays,
)
from stickslip_schemas.kinds.cloth.scene_axes import BuiltIn, ClothSceneAxes
from stickslip_schemas.kinds.cloth.sensitivities import (
    Differentiated,
    differentiated,
    why_not_differentiable,
    with_derivatives,
)
from stickslip_schemas.kinds.cloth.spec import ClipRender, ClipSpec
from stickslip_schemas.scene.document import Physics, Scene, Staged
from stickslip_schemas.scene.library import load_scene
from stickslip_schemas.scene.parameters import (
    LOOKS_AXES,
    Location,
    refuse,
    refuse_as,
    resolve_path,
    with_values,
)
from stickslip_schemas.scene.parts import MeshBody
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.spec.axes import AnyAxis, ListAxis, Seed, extremes
from stickslip_schemas.spec.cameras import FRAMING, Camera, load_rig, rig_cameras, rig_digest
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS, Costs, SeedRule, Simulation, StartFault
from stickslip_schemas.spec.names import FloorNumbers, LampNumbers, did_you_mean

OF_SCENE = "scene"
"""Name of the light and the floor that the scene gives as numbers."""


class ClothSceneSimulation(Simulation):
    """The trajectory of a scene: all that it depends on besides the build."""

    kind: Literal["cloth_scene"] = "cloth_scene"
    scene: Physics
    seed: Seed
    sensitivities: dict[str, Differentiated] = Field(
        default_factory=dict,
        exclude_if=lambda by_name: not by_name,
        description="what the run is differentiated by, by name",
    )

    @property
    def artifacts(self) -> tuple[Sha256, ...]:
        return tuple(filter(None, (artifact_digest(name) for _, name in self.scene.files())))

    @property
    def vertices(self) -> int:
        return sum(sheet.mesh.shape[0] for sheet in self.scene.sheets.values())

    def inputs(self, read: Callable[[str], bytes]) -> dict[str, Any]:
        """Return the scene with the arrays of its files, and the seed.

        Raises UnfitFileError, or UnfitStartError for a scene that can never work.
        """
        from stickslip_schemas.scene.files import with_arrays  # needs the extra `arrays`
        from stickslip_schemas.scene.start import check_start

        scene = with_arrays(self.scene, read)
        check_start(scene)
        by_name = {name: by.model_dump(mode="json") for name, by in self.sensitivities.items()}
        return {"scene": scene, "seed": self.seed, "sensitivities": by_name}


class ClothSceneRender(ClipRender):
    """How a scene is seen."""

    kind: Literal["cloth_scene"] = "cloth_scene"
    rig: str | None = Field(
        default=None, description="null: `camera`, or one that frames all that moves"
    )
    rig_digest: Sha256 | None = None
    scene: Staged

    @property
    def material(self) -> str:
        """The fabric of the sheet that takes the texture."""
        return self.scene.sheets[self.scene.textured].material

    @property
    def segments(self) -> tuple[str, ...]:
        return scene_segments(self.scene.sheets, self.scene.bodies)

    @property
    def artifacts(self) -> tuple[Sha256, ...]:
        return tuple(
            filter(
                None,
                (
                    artifact_digest(name)
                    for location, name in self.scene.files()
                    if location[0] == "looks"
                ),
            )
        )


class ClothSceneSpec(ClipSpec):
    """A scene of cloth that is data: built in, or of the user."""

    simulation_type = ClothSceneSimulation
    render_type = ClothSceneRender
    simulation_seeds = (SeedRule("seed", "bias", None),)
    render_seeds = (SeedRule("light_seed", "light", None), SeedRule("crease_seed", "creases", None))

    has_scene = True

    kind: Literal["cloth_scene"]
    scene: Annotated[
        Scene, BuiltIn(lambda scene: load_scene(scene) if isinstance(scene, str) else scene)
    ] = Field(description="the name of a built-in scene, or the document of a scene")
    set: dict[str, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="other values of the scene for all samples, by path",
    )
    axes: ClothSceneAxes

    @model_validator(mode="before")
    @classmethod
    def _draw_fabrics(cls, document: Any) -> Any:
        return fabric_axes.with_drawn_parameters(document)

    @field_validator("set")
    @classmethod
    def _can_be_set(
        cls, values: dict[str, JsonValue], info: ValidationInfo
    ) -> dict[str, JsonValue]:
        # A wrong scene has an error of its own, and no locations to set.
        if isinstance(scene := info.data.get("scene"), Scene):
            for path, value in values.items():
                try:
                    scene.physics_with({resolve_path(scene.physics(), path): value})
                except LookupError as error:
                    refuse(scene, (path,), str(error.args[0]), path)
                except ValidationError as error:
                    refuse_as(error, scene, (path,), value)
        return values

    @model_validator(mode="after")
    def _within_the_scene(self) -> Self:
        for name, axis in (self.axes.__pydantic_extra__ or {}).items():
            # An axis must be a parameter of the scene, within its range.
            known = self.stage.parameters
            if name not in known:
                rule = (
                    f"must be one of {', '.join((*known, *LOOKS_AXES))}{did_you_mean(name, known)}"
                )
                refuse(self, ("axes", name), rule, name)
            # The ends of a range stand for all values within it.
            for location, value in extremes(axis):
                if not known[name].allows(value):
                    refuse(
                        self,
                        ("axes", name, *location),
                        f"must be within {known[name].range}",
                        value,
                    )
        for corner in self._corners():
            values: dict[Location, Any] = {}
            for name, value in corner.items():
                values.update(dict.fromkeys(self.stage.locations(name), value))
            try:
                self.stage.physics_with(values)
            except ValidationError as error:
                refuse_as(error, self.stage, ("axes",), corner)
        return self

    def _corners(self) -> Iterator[dict[str, Any]]:
        """Yield points that stand for all others.

        These are all names, and the ends of ranges of numbers, one by one and two together. Rules
        between two numbers are linear, so a rule that holds at all ends holds between them.
        """
        # The ends of each axis. Names have no order, so each of them is an end.
        ends: dict[str, list[Any]] = {}
        for name, axis in (self.axes.__pydantic_extra__ or {}).items():
            values = [value for _, value in extremes(axis)]
            is_number = isinstance(self.stage.default(name), float)
            ends[name] = [min(values), max(values)] if is_number else values
            yield from ({name: value} for value in ends[name])
        for first, second in combinations(ends, 2):
            for a, b in product(ends[first], ends[second]):
                yield {first: a, second: b}

    @cached_property
    def stage(self) -> Scene:
        """The scene with the values of `set`."""
        # The scene is validated again with the values of `set`: its counts and frames may change.
        document = self.scene.model_dump(mode="json")
        return Scene.model_validate(
            with_values(document, {resolve_path(document, path): v for path, v in self.set.items()})
        )

    @cached_property
    def _parameter_fields(self) -> dict[str, tuple[str, ...]]:
        """Fields of documents that each parameter sets."""
        # Simulation and render hold the scene as one field, so the path begins with it.
        fields: dict[str, tuple[str, ...]] = {}
        for name in self.stage.parameters:
            locations = self.stage.locations(name)
            fields[name] = tuple("/".join(map(str, ("scene", *steps))) for steps in locations)
        return fields

    @cached_property
    def _sheets_of_fabrics(self) -> dict[str, tuple[str, ...]]:
        return fabric_axes.sheets_of_fabrics(self.stage)

    @property
    def named_axes(self) -> dict[str, AnyAxis]:
        """The axes by name: all parameters of the scene, then looks.

        A parameter without an axis has its default.
        """
        parameters: dict[str, AnyAxis] = dict(self.axes.__pydantic_extra__ or {})
        # Zipped axes have one length, so a default cannot stand among them.
        if self.combine != "zip":
            for name in self.stage.parameters.keys() - parameters.keys():
                default = self.stage.default(name)
                parameters[name] = ListAxis[Any](type="list", values=(default,))
        named = dict(sorted(parameters.items()))
        for name in LOOKS_AXES:
            axis = getattr(self.axes, name)
            if axis is not None:
                named[name] = axis
        return named

    @property
    def instants(self) -> int:  # type: ignore[override]
        return self.stage.frames

    @property
    def instants_per_second(self) -> float:  # type: ignore[override]
        return self.stage.frame_rate

    @property
    def segments(self) -> tuple[str, ...]:
        return scene_segments(self.stage.sheets, self.stage.bodies)

    def fields_of(self, axis: str) -> tuple[str, ...]:
        return self._parameter_fields.get(axis) or super().fields_of(axis)

    def document_fields(self, axis: str, value: Any) -> dict[str, Any]:
        if axis not in self._parameter_fields:
            return super().document_fields(axis, value)
        if axis not in self._sheets_of_fabrics:
            return dict.fromkeys(self._parameter_fields[axis], value)
        return fabric_axes.fabric_fields(self.stage, self._sheets_of_fabrics[axis], value)

    def key_value(self, axis: str, value: Any) -> Any:
        card = self.stage.materials.get(value) if axis in self._sheets_of_fabrics else None
        return value if card is None else card.identity

    def seed_axes(self, rule: SeedRule) -> tuple[str, ...]:
        """Return the axes whose values enter a seed.

        These are the parameters and, for the light, all axes but the texture, on which no shading
        depends.
        """
        # Renders that differ in their texture alone share a shading, and so its light.
        left_out = ("texture",) if rule.purpose == "light" else LOOKS_AXES
        return tuple(axis for axis in self.named_axes if axis not in left_out)

    def simulation_settings(self) -> dict[str, Any]:
        return {
            "scene": self.stage.with_slots(self.stage.physics()),
            "sensitivities": {
                name: differentiated(self.stage, name) for name in self.sensitivities
            },
        }

    @cached_property
    def differentiable_parameters(self) -> tuple[str, ...]:
        known = self.stage.parameters
        return tuple(name for name in known if not self.why_not_differentiable(name))

    def why_not_differentiable(self, name: str) -> str:
        if name not in self.stage.parameters:
            return ""
        return why_not_differentiable(self.stage, name)

    def parameter_unit(self, name: str) -> str:
        return self.stage.parameters[name].unit

    def render_settings(self) -> dict[str, Any] | None:
        looks = self.stage.looks
        settings = {
            **(super().render_settings() or {}),
            "scene": self.stage.with_slots(self.stage.staged()),
        }
        # Cameras, light and floor are names, or numbers of the scene.
        if isinstance(looks.cameras, str):
            settings["rig"] = looks.cameras
            settings["rig_digest"] = rig_digest(looks.cameras)
        settings["lighting"] = str(looks.light)
        if isinstance(looks.light, LampNumbers):
            settings["lighting"] = OF_SCENE
            settings["lamp"] = looks.light
        settings["substrate"] = str(looks.floor)
        if isinstance(looks.floor, FloorNumbers):
            settings["substrate"] = OF_SCENE
            settings["finish"] = looks.floor
        return settings

    @cached_property
    def _scene_definitions(self) -> Mapping[str, Mapping[str, Any]]:
        """Definitions of names in the scene, by axis."""
        looks = self.stage.looks
        return {
            "viewpoint": looks.cameras if isinstance(looks.cameras, dict) else {},
            "lighting": {OF_SCENE: looks.light} if isinstance(looks.light, LampNumbers) else {},
            "substrate": {OF_SCENE: looks.floor} if isinstance(looks.floor, FloorNumbers) else {},
        }

    def built_in(self, axis: str) -> tuple[str, ...]:
        """Return the names that an axis may use without a definition in the spec.

        Names of the scene are among them.
        """
        # A rig and the framing cameras are built in; cameras of the scene are defined by it.
        cameras = self.stage.looks.cameras
        if axis == "viewpoint" and not isinstance(cameras, dict):
            return tuple(
                FRAMING if cameras is None else (camera.name for camera in load_rig(cameras))
            )
        return (*super().built_in(axis), *self._scene_definitions.get(axis, {}))

    def meaning(self, axis: str, name: str) -> Any:
        return super().meaning(axis, name) or self._scene_definitions.get(axis, {}).get(name)

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras by name.

        Cameras that frame all that moves differ from sample to sample and are not among them.
        """
        looks_cameras = self.stage.looks.cameras
        rig: tuple[Camera, ...] = ()
        if isinstance(looks_cameras, str):
            rig = rig_cameras(looks_cameras, self.resolution)
        views = {**self._scene_definitions["viewpoint"], **self.viewpoints}
        return (*rig, *(view.camera(name, self.resolution) for name, view in views.items()))

    @property
    def artifacts(self) -> dict[str, Sha256]:
        pointers = dict(super().artifacts)
        for location, name in self.scene.files():
            digest = artifact_digest(name)
            if digest:
                pointers["/".join(("/scene", *map(str, location)))] = digest
        return pointers

    @property
    def certified_preset(self) -> str:
        return self.stage.preset.value

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        """Return the protocols of contact if cloth touches cloth or meshes."""
        # Cloth on cloth, and cloth on triangles, need protocols that a plane does not.
        of_cloth = any(other in self.stage.sheets for _, other in self.stage.pairs())
        of_mesh = any(isinstance(body, MeshBody) for body in self.stage.bodies.values())
        return CONTACT_PROTOCOLS if of_cloth or of_mesh else ()

    @property
    def default_costs(self) -> Costs:
        """CPU times of the packaged records.

        Cloth that rests costs a tenth of the middle, and cloth in full swing ten times as much.
        """
        # Time grows with the vertices, more than in proportion, and with the length of the scene.
        vertices = sum(sheet.mesh.shape[0] for sheet in self.stage.sheets.values())
        duration = self.stage.frames / self.stage.frame_rate
        seconds = 1e-4 * vertices**1.37 * duration
        # Renders of over-the-edge, wipe and peg took 0.7, 0.5 and 0.5 times as long as a drag's.
        return self.clip_costs(seconds, uncertainty_factor=10.0, render_factor=2.5)

    @cached_property
    def _cost_of_scene(self) -> str:
        return self.stage.digest[:12]

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        """Return the group of samples that cost about the same.

        Samples group by scene, by names of fabrics, and by numbers to one digit.
        """
        if stage is Stage.render:
            return f"{super().cost_group(stage, point)}, {self._cost_of_scene}"
        names = self._parameter_fields
        words = (fabric_axes.cost_words(self.stage, point.get(name)) for name in names)
        return with_derivatives(", ".join((self._cost_of_scene, *words)), self)

    def arrays(self) -> tuple[ArrayLayout, ...]:
        # With zipped axes, a parameter without an axis has no label.
        labels = (
            parameter_label(self.stage, name)
            for name in self.stage.parameters
            if name in self.named_axes
        )
        return (*clip_arrays(self), *labels, *scene_arrays(self, self.stage))

    def scene_place(self, pointer: str) -> tuple[str, ...] | None:
        word, *location = pointer.split("/")[1:]
        is_of_physics = word == "scene" and location[0] != "looks"
        return tuple(location) if is_of_physics else None

    def check_scene_file(self, location: tuple[str, ...], data: bytes) -> None:
        from stickslip_schemas.scene.files import check_scene_file  # needs the extra `arrays`

        check_scene_file(self.stage, location, data)

    def start_faults(self, read: Callable[[str], bytes]) -> list[StartFault]:
        from stickslip_schemas.scene.files import with_arrays  # needs the extra `arrays`
        from stickslip_schemas.scene.start import find_start_faults

        # Files do not depend on parameters, so they are read once.
        document = with_arrays(self.stage, read)
        faults: list[StartFault] = []
        for values in self._typical_values():
            now = find_start_faults(with_values(document, values))
            # One sample that may work is enough: the others are rejected one by one.
            if not now:
                return []
            faults = faults or now
        return [fault._replace(location=("scene", *fault.location)) for fault in faults]

    def _typical_values(self) -> Iterator[dict[Location, Any]]:
        """Yield values of the axes, by location in the scene: the first, the middle, the last.

        A spec without an axis of the scene has one sample in this respect.
        """
        axes = self.axes.__pydantic_extra__ or {}
        values = {name: [value for _, value in extremes(axis)] for name, axis in axes.items()}
        for name, axis in axes.items():
            if not isinstance(axis, ListAxis):
                low, high = values[name]
                values[name] = [low, 0.5 * (low + high), high]
        for fraction in (0.0, 0.5, 1.0) if values else (0.0,):
            by_location: dict[Location, Any] = {}
            for name, choices in values.items():
                choice = choices[round(fraction * (len(choices) - 1))]
                by_location |= dict.fromkeys(self.stage.locations(name), choice)
            yield by_location

    def unresolved_files(self) -> dict[str, str]:
        return {
            "/".join(("/scene", *map(str, location))): name
            for location, name in self.scene.files()
            if artifact_digest(name) is None
        }

    def looks_arrays(self) -> tuple[ArrayLayout, ...]:
        return clip_arrays(self)

    def check_arrays(self) -> tuple[ArrayLayout, ...]:
        return solver_arrays(self)

    @property
    def scene_numbers(self) -> tuple[str, ...]:
        return tuple(
            name for name in self.stage.parameters if isinstance(self.stage.default(name), float)
        )

    def sample_scene(
        self, numbers: Mapping[str, float], read: Callable[[str], bytes]
    ) -> dict[str, Any] | None:
        from stickslip_schemas.scene.files import with_arrays  # needs the extra `arrays`

        # One parameter may set several places of the document.
        values = {
            location: numbers[name]
            for name in self.scene_numbers
            for location in self.stage.locations(name)
        }
        return with_arrays(self.stage.physics_with(values), read)

    @property
    def located_holders(self) -> tuple[int, ...]:
        sheets = self.stage.sheets
        holders = [sheets[sheet].holders[name] for sheet, name in self.stage.holders]
        return tuple(number for number, holder in enumerate(holders) if holder.rim is None)
