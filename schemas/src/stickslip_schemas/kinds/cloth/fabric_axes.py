"""Axes of fabrics: cards that an axis draws, and the fields of a sample that a fabric sets."""

from collections.abc import Iterable
from typing import Any

from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene, scene_names
from stickslip_schemas.spec.fabrics import drawn_cards, is_distribution


def with_drawn_material(document: Any) -> Any:
    """Return the document of a drag with a card for each fabric that its axis draws.

    Raises ValidationError for a wrong distribution. Other faults are left to the model.
    """
    axes = document.get("axes") if isinstance(document, dict) else None
    axis = axes.get("material") if isinstance(axes, dict) else None
    if not (isinstance(axes, dict) and is_distribution(axis)):
        return document
    defined = _cards_of(document)
    cards = drawn_cards(axis, ("axes", "material"), defined)
    return document | {
        "axes": axes | {"material": list(cards)},
        "materials": {**defined, **cards},
    }


def with_drawn_parameters(document: Any) -> Any:
    """Return the document of a scene's job with a card in the scene for each drawn fabric.

    Raises ValidationError for a wrong distribution. Other faults are left to the model.
    """
    axes = document.get("axes") if isinstance(document, dict) else None
    if not isinstance(axes, dict):
        return document
    drawn = {name: axis for name, axis in axes.items() if is_distribution(axis)}
    scene = document.get("scene")
    if isinstance(scene, str) and drawn and scene in scene_names():
        scene = load_scene(scene).model_dump(mode="json")
    # A scene that is none has an error of its own.
    if not (drawn and isinstance(scene, dict)):
        return document
    materials = _cards_of(scene)
    for name, axis in drawn.items():
        cards = drawn_cards(axis, ("axes", name), materials)
        materials.update(cards)
        axes = axes | {name: list(cards)}
    return document | {"axes": axes, "scene": scene | {"materials": materials}}


def _cards_of(document: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of the cards that a document defines; none if they are no mapping."""
    materials = document.get("materials")
    return dict(materials) if isinstance(materials, dict) else {}


def fabric_fields(stage: Scene, sheets: Iterable[str], fabric: str) -> dict[str, Any]:
    """Return the fields of a sample's documents that a fabric of some sheets sets.

    A fabric is a name of its sheet, and its numbers under this name.
    """
    fields: dict[str, Any] = {}
    for sheet in sheets:
        material, numbers = stage.slotted(sheet, fabric)
        fields[f"scene/sheets/{sheet}/material"] = material
        fields[f"scene/materials/{stage.slot(sheet)}"] = numbers
    return fields


def sheets_of_fabrics(stage: Scene) -> dict[str, tuple[str, ...]]:
    """Return the sheets whose fabric each parameter of fabrics sets; empty without slots."""
    sheets: dict[str, tuple[str, ...]] = {}
    for name in stage.parameters if stage.has_slots else ():
        if isinstance(stage.default(name), str):
            sheets[name] = tuple(str(location[1]) for location in stage.locations(name))
    return sheets


def cost_words(stage: Scene, value: object) -> str:
    """Return a value of a parameter in the name of a group of samples that cost about the same.

    Drawn fabrics of one size are one group: each has few samples.
    """
    if isinstance(value, float):
        return f"{value:.1g}"
    card = stage.materials.get(str(value))
    return str(value) if card is None else card.size_words
