"""Scenes: built-in ones, and those of jobs, with the datasets made of them."""

import json
from dataclasses import dataclass, field

from sqlalchemy import Connection, select
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene, scene_names

from stickslip_services.access.asker import own
from stickslip_services.database.tables import dataset_versions, jobs

KIND = "cloth_scene"
NEWEST = 1000
"""Jobs whose scenes are listed."""


@dataclass
class KnownScene:
    """A scene, and the dataset versions that were made of it, newest first."""

    scene: Scene
    is_built_in: bool
    versions: list[tuple[str, int]] = field(default_factory=list)


def known_scenes(connection: Connection) -> dict[str, KnownScene]:
    """Return scenes by digest: the built-in ones, and those of the newest jobs."""
    found = {scene.digest: KnownScene(scene, is_built_in=True) for scene in map(load_scene, scene_names())}
    rows = connection.execute(
        select(jobs.c.spec, jobs.c.dataset, jobs.c.version)
        .where(jobs.c.kind == KIND, own(jobs.c.project))
        .order_by(jobs.c.seq.desc())
        .limit(NEWEST)
    )
    kept = dataset_versions.c.manifest.is_not(None)
    there = {
        tuple(one)
        for one in connection.execute(select(dataset_versions.c.dataset, dataset_versions.c.version).where(kept))
    }
    for row in rows:
        scene = Scene.model_validate(json.loads(row.spec)["scene"])
        known = found.setdefault(scene.digest, KnownScene(scene, is_built_in=False))
        version = (row.dataset, row.version)
        if version in there and version not in known.versions:
            known.versions.append(version)
    return found
