"""The rule that some kinds are made with certified presets only."""

from sqlalchemy import Connection
from stickslip_schemas.kinds import registered
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.catalog.certificates import standing_certificate
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.plan import Terms
from stickslip_services.queue.workers import builds_for


def terms_for(connection: Connection, spec: JobSpec) -> Terms | None:
    """Return what a job of `spec` is made with, None where no worker has ever registered.

    Raise KindNotAvailableError where no worker makes the kind, UnknownKindError where nobody registered its class, and
    PresetNotCertifiedError where the spec needs a certificate and its preset has none that passed for the workers'
    build, with all protocols that the spec needs.
    """
    builds = builds_for(connection, registered(spec).kind)
    if builds is None:
        return None
    standing = standing_certificate(connection, spec.certified_preset, builds.sim_core)
    missing = [] if standing is None else [name for name in spec.certified_protocols if name not in standing.protocols]
    certificate = None if standing is None or missing else standing.digest
    if certificate is None and spec.needs_certificate:
        raise PresetNotCertifiedError(spec.certified_preset, builds.sim_core, missing)
    return Terms(builds, certificate)
