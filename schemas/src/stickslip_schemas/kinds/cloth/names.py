"""Names in a spec of cloth: materials, textures, lamps and floors, the built-in ones and those that users add."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from stickslip_schemas.base.document import Document
from stickslip_schemas.base.keys import ArtifactRef, Sha256, referred
from stickslip_schemas.scene.looks import View
from stickslip_schemas.spec.appearance import Calibration, FloorNumbers, LampNumbers, Lighting, Substrate
from stickslip_schemas.spec.axes import SHORTHAND, ListAxis, quantity
from stickslip_schemas.spec.fabrics import CustomName, Texture, did_you_mean, name_schema
from stickslip_schemas.spec.jobs import JobSpec

VIEWPOINT = Field(description="camera of the rig, or a custom one under `viewpoints`")
TextureAxis = Annotated[
    ListAxis[Annotated[CustomName, quantity("Texture"), name_schema(Texture)]],
    SHORTHAND,
    Field(description="pattern of the cloth, or a custom one under `textures`; the last four are held out for tests"),
]
LampAxis = Annotated[
    Annotated[ListAxis[Annotated[CustomName, quantity("Lighting"), name_schema(Lighting)]], SHORTHAND] | None,
    Field(description="range of lamps, or a custom one under `lamps`; by default `drawn`"),
]
SubstrateAxis = Annotated[ListAxis[Annotated[CustomName, quantity("Substrate"), name_schema(Substrate)]], SHORTHAND]


class Custom(NamedTuple):
    """Where the spec defines what an axis of names may name besides what is built in."""

    key: str
    """Of the spec: a mapping from the user's names to what they mean."""
    field: str
    """Of the document that takes it."""
    built_in: tuple[str, ...]


def definitions(what: str, axis: str, more: str = "", *, at_most: int | None = 64) -> Any:
    """Return the field of a spec that defines custom names of an axis."""
    return Field(
        default_factory=dict,
        max_length=at_most,
        description=f"custom {what}, by the names that the axis `{axis}` uses{more}",
        json_schema_extra={"additionalProperties": False},
    )


class NamingSpec(JobSpec):
    """A spec whose axes of names take custom names, which the spec defines."""

    custom: ClassVar[Mapping[str, Custom]] = {
        "texture": Custom("textures", "image", tuple(Texture)),
        "viewpoint": Custom("viewpoints", "camera", ()),
        "lighting": Custom("lamps", "lamp", tuple(Lighting)),
        "substrate": Custom("substrates", "finish", tuple(Substrate)),
    }
    """By axis of names, what the user may add to it."""

    textures: dict[CustomName, ArtifactRef] = definitions(
        "textures", "texture", ": `sha256:` and the digest that `stickslip upload` prints"
    )
    viewpoints: dict[CustomName, Calibration] = definitions("cameras", "viewpoint")
    lamps: dict[CustomName, LampNumbers] = definitions("lamps", "lighting")
    substrates: dict[CustomName, FloorNumbers] = definitions("floors", "substrate")

    def fields_of(self, axis: str) -> tuple[str, ...]:
        """Return the fields of documents that an axis sets: its name, and what the name means."""
        return (axis, self.custom[axis].field) if axis in self.custom else (axis,)

    def document_fields(self, axis: str, value: Any) -> dict[str, Any]:
        """Return the fields that a value of an axis sets: what the user has defined brings its numbers along."""
        if axis not in self.custom:
            return {axis: value}
        given = self.meaning(axis, value)
        if isinstance(given, Calibration | View):
            given = given.camera(value)
        return {
            axis: value,
            self.custom[axis].field: given.model_dump(mode="json") if isinstance(given, Document) else given,
        }

    def _defined(self, axis: str) -> dict[str, Any]:
        defined: dict[str, Any] = getattr(self, self.custom[axis].key)
        return defined

    def built_in(self, axis: str) -> tuple[str, ...]:
        """Return the names that an axis may use without a definition in the spec."""
        return tuple(map(str, self.custom[axis].built_in))

    def meaning(self, axis: str, name: str) -> Any:
        """Return what the user has defined a name of an axis to be; None where it needs no definition."""
        return self._defined(axis).get(name)

    def names(self, axis: str) -> tuple[str, ...]:
        """Return the names that an axis may use, the built-in ones first: they are the codes of the label."""
        return (*self.built_in(axis), *self._defined(axis))

    @property
    def artifacts(self) -> dict[str, Sha256]:
        return {f"/textures/{name}": digest for name, image in self.textures.items() if (digest := referred(image))}

    @model_validator(mode="after")
    def _known_names(self) -> Self:
        unknown = []
        for axis in self.custom:
            for name in self._defined(axis):
                if name in self.built_in(axis):
                    raise ValueError(f"{self.custom[axis].key} must not redefine what is built in, and {name!r} is")
            known = self.names(axis)
            given = getattr(self.axes, axis)
            unknown += [
                InitErrorDetails(
                    type=PydanticCustomError(
                        "unknown_name",
                        "Input should be one of {known}{hint}",
                        {"known": ", ".join(known), "hint": did_you_mean(name, known)},
                    ),
                    loc=("axes", axis, "list", "values", position),
                    input=name,
                )
                for position, name in enumerate(() if given is None else given.values)
                if name not in known
            ]
        if unknown:
            raise ValidationError.from_exception_data(type(self).__name__, unknown)
        return self
