"""Certificates: registering and finding them."""

from typing import Any

from sqlalchemy import Connection, Row, insert, select, update
from stickslip_schemas.base import Sha256
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.responses import CertificateEntry, Page
from stickslip_schemas.store import Store

from stickslip_services.access.audit_log import note
from stickslip_services.database.database import Database
from stickslip_services.database.paging import PageRequest, document_of, read_page
from stickslip_services.database.tables import certificates
from stickslip_services.errors import NotFoundError


def standing_certificate(connection: Connection, preset: str, sim_core: Sha256) -> tuple[Sha256, list[str]] | None:
    """Return digest and protocols of the newest full certificate of a preset and a build, if it passed."""
    columns = certificates.c
    row = connection.execute(
        select(columns.digest, columns.passed, columns.protocols)
        .where(columns.preset == preset, columns.sim_core == sim_core, columns.extent == "full")
        .order_by(columns.created_at.desc(), columns.seq.desc())
        .limit(1)
    ).one_or_none()
    return (row.digest, row.protocols.split()) if row is not None and row.passed else None


def register_certificate(database: Database, store: Store, certificate: Certificate, now: float) -> CertificateEntry:
    """Store a certificate, and register it; a known one becomes the newest again."""
    artifact = store.publish(certificate.canonical())
    values = {"created_at": now, "protocols": " ".join(report.protocol for report in certificate.protocols)}
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
        note(connection, "certificate.register", entry.digest, now, preset=entry.preset, passed=entry.passed)
        return entry


def list_certificates(connection: Connection, page: PageRequest) -> Page[CertificateEntry]:
    """Return a page of certificates, newest first."""
    return read_page(connection, select(certificates), page, certificates.c.seq, lambda rows: map(_entry, rows))


def find_certificate(connection: Connection, digest: str) -> Row[tuple[Any, ...]]:
    """Return the row of a certificate; raise NotFoundError."""
    row = connection.execute(select(certificates).where(certificates.c.digest == digest)).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no certificate {digest[:100]!r}")
    return row


def _entry(row: Row[tuple[Any, ...]]) -> CertificateEntry:
    return document_of(CertificateEntry, row, href=f"/v1/certificates/{row.digest}")
