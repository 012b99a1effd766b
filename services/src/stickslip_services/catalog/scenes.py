"""The scenes that the coordinator knows: the built-in scenes, and the scenes of jobs."""

import json
from dataclasses import dataclass, field

from sqlalchemy import Connection, select
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene, scene_names

from stickslip_services.access.principals import is_visible_project
from stickslip_services.database.tables import dataset_versions, jobs

MAX_JOBS = 1000
"""Newest jobs whose scenes are listed: about 0.5 s to read."""

_SCENE_KINDS = [name for name, spec_type in KINDS.items() if "scene" in spec_type.model_fields]


@dataclass
class KnownScene:
    """A scene, and the dataset versions that were made of it, newest first."""

    scene: Scene
    is_built_in: bool
    versions: list[tuple[str, int]] = field(default_factory=list)


def known_scenes(connection: Connection) -> dict[str, KnownScene]:
    """Return scenes by digest: the built-in scenes, and the scenes of the newest jobs."""
    built_in = [load_scene(name) for name in scene_names()]
    known = {scene.digest: KnownScene(scene, is_built_in=True) for scene in built_in}
    query = (
        select(jobs.c.spec, jobs.c.dataset, jobs.c.version)
        .where(jobs.c.kind.in_(_SCENE_KINDS), is_visible_project(jobs.c.project))
        .order_by(jobs.c.seq.desc())
        .limit(MAX_JOBS)
    )
    committed = _committed_versions(connection)
    for job in connection.execute(query):
        scene = Scene.model_validate(json.loads(job.spec)["scene"])
        entry = known.setdefault(scene.digest, KnownScene(scene, is_built_in=False))
        # Several jobs may have made the same version, and a job may have made none.
        version = (job.dataset, job.version)
        if version in committed and version not in entry.versions:
            entry.versions.append(version)
    return known


def _committed_versions(connection: Connection) -> set[tuple[str, int]]:
    """Return dataset and number of each version that is in the store."""
    columns = dataset_versions.c
    query = select(columns.dataset, columns.version).where(columns.manifest.is_not(None))
    return {(row.dataset, row.version) for row in connection.execute(query)}
