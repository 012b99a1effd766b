"""Which code makes the data: the builds that enter every content key."""

from stickslip_schemas.base.document import Document
from stickslip_schemas.base.keys import Sha256, content_key


class Builds(Document):
    """Build digests of one kind; tasks are leased only to workers of the builds they were planned for.

    Each digest is over the files that the work of that stage imports, over compilers, libraries and settings, so equal
    digests mean equal results.
    """

    sim_core: Sha256
    """Of the solver alone: what a certificate vouches for."""
    simulate: Sha256
    """Of all that makes a trajectory: the solver, the scene and the stage."""
    render: Sha256
    """Of all that makes pictures: the renderer and the scene."""
    pack: Sha256
    """Of all that writes a dataset: the arrays, codecs and metadata."""

    @property
    def digest(self) -> str:
        """One key for all of them."""
        return content_key("builds", self.model_dump())
