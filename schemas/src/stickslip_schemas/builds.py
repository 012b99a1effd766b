"""Which code makes the data: the builds that enter every content key."""

from stickslip_schemas.base import Document
from stickslip_schemas.keys import Sha256, content_key


class Builds(Document):
    """Build digests of a fleet of workers; tasks are leased only to workers of the builds they were planned for.

    Each digest is over sources, compiler and settings, so equal digests mean equal results.
    """

    sim_core: Sha256
    blender: Sha256
    packer: Sha256

    @property
    def digest(self) -> str:
        """One key for all of them."""
        return content_key("builds", self.model_dump())
