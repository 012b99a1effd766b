"""What a job is made with, and the rule that cloth is made with certified presets only."""

from dataclasses import dataclass

from sqlalchemy import Connection
from stickslip_schemas.builds import Builds
from stickslip_schemas.certificate import preset_of
from stickslip_schemas.jobs import ClothDragSpec
from stickslip_schemas.keys import Sha256

from stickslip_services.catalog.certificates import standing_certificate
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.planning import Spec
from stickslip_services.queue.workers import builds_for


@dataclass(frozen=True, slots=True)
class Terms:
    """What a job is made with: the builds of the workers, and the certificate that vouches for them, if any does."""

    builds: Builds
    certificate: Sha256 | None


def terms_for(connection: Connection, spec: Spec) -> Terms | None:
    """Return what a job of `spec` is made with, None where no worker has ever registered.

    Raise KindNotAvailableError where no worker makes the kind, and PresetNotCertifiedError for cloth of a preset that
    has no passing certificate for the workers' build, unless the spec allows for it. Rods need none.
    """
    builds = builds_for(connection, spec.kind)
    if builds is None:
        return None
    certificate = standing_certificate(connection, preset_of(spec), builds.sim_core)
    if certificate is None and isinstance(spec, ClothDragSpec) and not spec.allow_uncertified:
        raise PresetNotCertifiedError(str(spec.preset), builds.sim_core)
    return Terms(builds, certificate)
