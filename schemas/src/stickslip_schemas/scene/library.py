"""Built-in scenes: YAML files of this package, and the files that they name."""

from functools import cache
from pathlib import Path

from stickslip_schemas.scene.document import Scene
from stickslip_schemas.spec.names import did_you_mean
from stickslip_schemas.spec.yaml_documents import parse_yaml

SCENES = Path(__file__).parents[1] / "scenes"
"""Folder of the built-in scenes."""


@cache
def scene_names() -> tuple[str, ...]:
    """Return the names of the built-in scenes, in order."""
    return tuple(sorted(file.stem for file in SCENES.glob("*.yaml")))


@cache
def _loaded(name: str) -> tuple[Scene, dict[str, bytes]]:
    """Return a built-in scene, and its files by digest."""
    # The name of a built-in scene is that of its file.
    text = (SCENES / f"{name}.yaml").read_text(encoding="utf-8")
    scene = Scene.model_validate({"name": name, **parse_yaml(text)})
    if not any(scene.files()):
        return scene, {}
    from stickslip_schemas.scene.files import inlined  # needs the extra `arrays`

    return inlined(scene, lambda file: (SCENES / file).read_bytes())


def load_scene(name: str) -> Scene:
    """Return a built-in scene, whose files are references to artifacts.

    Raises ValueError for an unknown name.
    """
    # A name comes from a spec, and must not become a path.
    if name not in scene_names():
        raise ValueError(
            f"must be one of {', '.join(scene_names())}, or a "
            f"scene{did_you_mean(name, scene_names())}"
        )
    return _loaded(name)[0]


@cache
def built_in_files() -> dict[str, bytes]:
    """Return the files that built-in scenes name, by digest.

    A coordinator stores them when a job needs them.
    """
    return {digest: data for name in scene_names() for digest, data in _loaded(name)[1].items()}
