"""The foundations of jobs: certificates, and the uploaded files that specs name by digest."""

from pydantic import TypeAdapter
from sqlalchemy import Connection, Row, insert, select, update
from stickslip_schemas.base import ARTIFACT, Sha256
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.problems import FieldError
from stickslip_schemas.documents.responses import CertificateEntry, Page
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import Store

from stickslip_services.access import audit_log
from stickslip_services.access.principals import current_principal, is_visible_project
from stickslip_services.addresses import link
from stickslip_services.catalog.inspector import INSPECTOR
from stickslip_services.database.database import Database, PageRequest, document_of, read_page
from stickslip_services.database.tables import certificates, uploads
from stickslip_services.errors import NotFoundError, UnknownFileError

_FAULTS = TypeAdapter(list[FieldError])

_NOT_UPLOADED = "must name a file that was uploaded; `stickslip upload FILE` does it"
_NOT_RESOLVED = (
    "must be sha256: and the digest of an uploaded file; `stickslip submit` uploads files of scenes"
)


def register_certificate(
    database: Database, store: Store, certificate: Certificate, now: float
) -> CertificateEntry:
    """Store a certificate, and register it; a known one becomes the newest again."""
    # The file is written first: a row without its file would be an error forever, a file without
    # a row is garbage that `stickslip gc` collects.
    artifact = store.publish(certificate.canonical())
    values = {
        "created_at": now,
        "protocols": " ".join(report.protocol for report in certificate.protocols),
    }
    with database.write() as connection:
        known = update(certificates).where(certificates.c.digest == certificate.digest)
        is_known = connection.execute(known.values(values)).rowcount > 0
        if not is_known:
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


def find_certificate(connection: Connection, digest: str) -> Row[tuple[object, ...]]:
    """Return the row of a certificate; raise NotFoundError."""
    row = connection.execute(
        select(certificates).where(certificates.c.digest == digest)
    ).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no certificate {digest[:100]!r}")
    return row


def _entry(row: Row[tuple[object, ...]]) -> CertificateEntry:
    return document_of(CertificateEntry, row, href=link(f"/v1/certificates/{row.digest}"))


def check_files(database: Database, store: Store, spec: JobSpec) -> None:
    """Raise UnknownFileError if a spec names files that are missing, damaged, or of another form.

    Files of other projects are treated as missing. Files of built-in scenes are stored first.
    """
    visible = _visible_uploads(database, spec)
    wrong = [
        FieldError(pointer=pointer, rule=rule, value=f'"{ARTIFACT}{digest}"')
        for pointer, digest in spec.artifacts.items()
        if (rule := _broken_rule(store, spec, pointer, digest, visible))
    ]
    wrong += [
        FieldError(pointer=pointer, rule=_NOT_RESOLVED, value=f'"{name}"')
        for pointer, name in spec.unresolved_files().items()
    ]
    if not wrong and spec.has_scene:
        wrong = _start_faults(store, spec)
    if wrong:
        raise UnknownFileError(wrong)


def _start_faults(store: Store, spec: JobSpec) -> list[FieldError]:
    """Return why no sample of a spec can be valid, found by geometry before anything is queued.

    The files of the scene must have been checked.
    """
    files: dict[Sha256, bytes] = {}
    for pointer, digest in spec.artifacts.items():
        if spec.scene_place(pointer) is not None:
            files[digest] = store.read(digest)
    sizes = [(digest, len(data)) for digest, data in files.items()]
    question = {"inspection": "start", "spec": spec.model_dump_json(), "files": sizes}
    try:
        faults = INSPECTOR.inspect_bytes(b"".join(files.values()), question)
    # The limits of the inspection are a rule, too: a scene that cannot be checked is refused.
    except UnfitFileError as error:
        rule = f"must be a scene whose start can be checked: {error}"
        return [FieldError(pointer="/scene", rule=rule, value="")]
    return _FAULTS.validate_python(faults)


def _visible_uploads(database: Database, spec: JobSpec) -> set[Sha256]:
    """Return the files of a spec that the project of the principal has uploaded."""
    query = select(uploads.c.digest).where(
        uploads.c.digest.in_(spec.artifacts.values()), is_visible_project(uploads.c.project)
    )
    with database.read() as connection:
        return set(connection.scalars(query))


def _broken_rule(
    store: Store, spec: JobSpec, pointer: str, digest: Sha256, visible: set[Sha256]
) -> str:
    """Return the rule that a file at a pointer breaks; an empty text if it fits."""
    # Everybody may use the files that come with the distribution.
    built_in = built_in_files().get(digest)
    if built_in is not None and not store.exists(digest):
        store.publish(built_in)
    may_read = built_in is not None or digest in visible or current_principal().sees_all
    if not may_read:
        return _NOT_UPLOADED
    try:
        # The store compares the file with its digest, so a damaged one counts as missing.
        data = store.read(digest)
    except OSError:
        return _NOT_UPLOADED
    try:
        _check_artifact(data, spec, pointer)
    except UnfitFileError as error:
        return f"must name a file that fits: {error}"
    return ""


def _check_artifact(data: bytes, spec: JobSpec, pointer: str) -> None:
    """Raise UnfitFileError if a file is not what a spec needs at a pointer."""
    question = {"inspection": "artifact", "spec": spec.model_dump_json(), "pointer": pointer}
    INSPECTOR.inspect_bytes(data, question)
