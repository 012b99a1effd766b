"""What jobs build on: certificates.

Uploaded textures, meshes and paths, which specs name by digest; and scenes.
"""

import json
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update
from stickslip_schemas.base import ARTIFACT, Sha256
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.problems import FieldError
from stickslip_schemas.documents.responses import CertificateEntry, FileUpload, Page, TextureEntry
from stickslip_schemas.format.pictures import UnfitPictureError, read_picture
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import UnfitFileError, check_scene_file, counts_of
from stickslip_schemas.scene.library import built_in_files, load_scene, scene_names
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import Store

from stickslip_services.access import audit_log
from stickslip_services.access.principals import current_principal, is_visible_project
from stickslip_services.database.database import Database, PageRequest, document_of, read_page
from stickslip_services.database.tables import certificates, dataset_versions, jobs, uploads
from stickslip_services.errors import NotFoundError, UnknownFileError


def standing_certificate(
    connection: Connection, preset: str, sim_core: Sha256
) -> tuple[Sha256, list[str]] | None:
    """Return digest and protocols of the newest full certificate of a preset and a build, if it
    passed.
    """
    columns = certificates.c
    row = connection.execute(
        select(columns.digest, columns.passed, columns.protocols)
        .where(columns.preset == preset, columns.sim_core == sim_core, columns.extent == "full")
        .order_by(columns.created_at.desc(), columns.seq.desc())
        .limit(1)
    ).one_or_none()
    return (row.digest, row.protocols.split()) if row is not None and row.passed else None


def register_certificate(
    database: Database, store: Store, certificate: Certificate, now: float
) -> CertificateEntry:
    """Store a certificate, and register it; a known one becomes the newest again."""
    artifact = store.publish(certificate.canonical())
    values = {
        "created_at": now,
        "protocols": " ".join(report.protocol for report in certificate.protocols),
    }
    with database.write() as connection:
        known = update(certificates).where(certificates.c.digest == certificate.digest)
        if connection.execute(known.values(values)).rowcount == 0:
            connection.execute(
                insert(certificates).values(
                    digest=certificate.digest,
                    artifact=artifact,
                    preset=certificate.preset,
                    sim_core=certificate.sim_core,
                    extent=certificate.extent,
                    passed=certificate.passed,
                    **values,
                )
            )
        entry = _entry(find_certificate(connection, certificate.digest))
        audit_log.append(
            connection,
            "certificate.register",
            entry.digest,
            now,
            preset=entry.preset,
            passed=entry.passed,
        )
        return entry


def list_certificates(connection: Connection, page: PageRequest) -> Page[CertificateEntry]:
    """Return a page of certificates, newest first."""
    return read_page(
        connection, select(certificates), page, certificates.c.seq, lambda rows: map(_entry, rows)
    )


def find_certificate(connection: Connection, digest: str) -> Row[tuple[Any, ...]]:
    """Return the row of a certificate; raise NotFoundError."""
    row = connection.execute(
        select(certificates).where(certificates.c.digest == digest)
    ).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no certificate {digest[:100]!r}")
    return row


def _entry(row: Row[tuple[Any, ...]]) -> CertificateEntry:
    return document_of(CertificateEntry, row, href=f"/v1/certificates/{row.digest}")


def store_texture(database: Database, store: Store, data: bytes) -> TextureEntry:
    """Store a picture file; raise UnfitPictureError where it cannot be a texture."""
    side = len(read_picture(data))
    return TextureEntry(
        texture=f"{ARTIFACT}{_store(database, store, data)}", side=side, bytes=len(data)
    )


def store_file(database: Database, store: Store, data: bytes) -> FileUpload:
    """Store a file of a scene; raise UnfitFileError where it can be none."""
    counts = counts_of(data)
    return FileUpload(
        file=f"{ARTIFACT}{_store(database, store, data)}", counts=counts, bytes=len(data)
    )


def _store(database: Database, store: Store, data: bytes) -> Sha256:
    """Store an artifact for the project of the principal."""
    row = {"project": current_principal().project, "digest": store.publish(data)}
    with database.write() as connection:
        if connection.scalar(select(uploads.c.digest).filter_by(**row)) is None:
            connection.execute(insert(uploads).values(row))
    return row["digest"]


def check_files(database: Database, store: Store, spec: JobSpec) -> None:
    """Raise UnknownFileError where a spec names files that are missing, damaged, or not what it
    needs.

    Those of other projects are as good as missing. Files of built-in scenes are stored first.
    """
    wrong = []
    with database.read() as connection:
        asked = select(uploads.c.digest).where(
            uploads.c.digest.in_(spec.artifacts.values()), is_visible_project(uploads.c.project)
        )
        uploaded = set(connection.scalars(asked))
    for pointer, digest in spec.artifacts.items():
        try:
            if (data := built_in_files().get(digest)) is not None:
                if not store.exists(digest):
                    store.publish(data)
            elif digest not in uploaded and not current_principal().sees_all:
                raise FileNotFoundError
            _check(spec, pointer, store.read(digest))
        except (UnfitPictureError, UnfitFileError) as error:
            rule = f"must name a file that fits: {error}"
        except OSError:
            rule = "must name a file that was uploaded; `stickslip upload FILE` does it"
        else:
            continue
        wrong.append(FieldError(pointer=pointer, rule=rule, value=f'"{ARTIFACT}{digest}"'))
    if isinstance(spec, ClothSceneSpec):
        for place, name in spec.scene.files():
            if not name.startswith(ARTIFACT):
                rule = "must be sha256: and the digest of an uploaded file; `stickslip submit` uploads files of scenes"
                wrong.append(
                    FieldError(
                        pointer="/".join(("/scene", *map(str, place))), rule=rule, value=f'"{name}"'
                    )
                )
    if wrong:
        raise UnknownFileError(wrong)


def _check(spec: JobSpec, pointer: str, data: bytes) -> None:
    """Raise UnfitPictureError or UnfitFileError where a file is not what the spec needs at a
    pointer.
    """
    words = pointer.split("/")[1:]
    if isinstance(spec, ClothSceneSpec) and words[0] == "scene" and words[1] != "looks":
        check_scene_file(spec.stage, tuple(words[1:]), data)
    else:
        read_picture(data)


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
    found = {
        scene.digest: KnownScene(scene, is_built_in=True)
        for scene in map(load_scene, scene_names())
    }
    rows = connection.execute(
        select(jobs.c.spec, jobs.c.dataset, jobs.c.version)
        .where(jobs.c.kind == KIND, is_visible_project(jobs.c.project))
        .order_by(jobs.c.seq.desc())
        .limit(NEWEST)
    )
    kept = dataset_versions.c.manifest.is_not(None)
    there = {
        tuple(one)
        for one in connection.execute(
            select(dataset_versions.c.dataset, dataset_versions.c.version).where(kept)
        )
    }
    for row in rows:
        scene = Scene.model_validate(json.loads(row.spec)["scene"])
        known = found.setdefault(scene.digest, KnownScene(scene, is_built_in=False))
        version = (row.dataset, row.version)
        if version in there and version not in known.versions:
            known.versions.append(version)
    return found
