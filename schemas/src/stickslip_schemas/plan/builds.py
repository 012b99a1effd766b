"""Builds: digests of the code that makes data, part of every content key."""

from stickslip_schemas.base.document import Document
from stickslip_schemas.base.keys import Sha256, content_key
from stickslip_schemas.base.states import Stage


class Builds(Document):
    """Build digests of one kind; tasks are leased only to workers of the builds they were planned for.

    Each digest is over the files that the work of that stage imports, over compilers, libraries and settings, so equal
    digests mean equal results.
    """

    sim_core: Sha256
    """The solver alone, which certificates cover."""
    simulate: Sha256
    """Solver, scene and simulate stage."""
    render: Sha256
    """Renderer and scene."""
    pack: Sha256
    """Arrays, codecs and metadata of a dataset."""

    @property
    def digest(self) -> str:
        """One key for all of them."""
        return content_key("builds", self.model_dump())

    @property
    def by_stage(self) -> dict[Stage, str]:
        """The build that a worker needs to run a task, by stage."""
        return dict(zip(Stage, (self.simulate, self.render, self.pack, self.digest), strict=True))
