"""Built-in scenes: YAML files of this package, and the files that they name."""

import re
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from stickslip_schemas.scene.document import Scene
from stickslip_schemas.spec.names import did_you_mean

SCENES = Path(__file__).parents[1] / "scenes"
"""Folder of the built-in scenes."""


class _Loader(yaml.SafeLoader):
    """YAML in which `1e-3` is a number and a repeated key is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is no word", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is there twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def parse_yaml(text: str) -> Any:
    """Return what a YAML file of ours holds; raise yaml.YAMLError."""
    return yaml.load(text, _Loader)


@cache
def scene_names() -> tuple[str, ...]:
    return tuple(sorted(file.stem for file in SCENES.glob("*.yaml")))


@cache
def _loaded(name: str) -> tuple[Scene, dict[str, bytes]]:
    """Return a built-in scene, and its files by digest."""
    text = (SCENES / f"{name}.yaml").read_text(encoding="utf-8")
    scene = Scene.model_validate({"name": name, **parse_yaml(text)})
    if not any(scene.files()):
        return scene, {}
    from stickslip_schemas.scene.files import inlined  # needs the extra `arrays`

    return inlined(scene, lambda file: (SCENES / file).read_bytes())


def load_scene(name: str) -> Scene:
    """Return a built-in scene, whose files are references to artifacts.

    Raise ValueError for an unknown name.
    """
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
