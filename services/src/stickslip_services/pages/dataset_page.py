"""The page of a dataset version that comes with its files: the accepted share, and the lost samples by region.

One HTML file, made from the manifest alone. It has no scripts and loads nothing.
"""

from collections import Counter
from itertools import islice

from stickslip_schemas.base.states import TaskState
from stickslip_schemas.format.manifest import Contents

from stickslip_services.pages.grid_map import grid_maps
from stickslip_services.pages.rendering import render

LISTED = 200
"""Most rejections that the page lists; the manifest lists all."""


def dataset_page(contents: Contents) -> str:
    """Return the page as HTML."""
    manifest, spec = contents.manifest, contents.manifest.spec
    maps = []
    if not manifest.sections:
        lost = {rejection.slot for rejection in manifest.rejections}
        states = [TaskState.rejected if slot in lost else TaskState.succeeded for slot in range(manifest.sample_count)]
        maps = [map_ for map_ in grid_maps(spec, states) if map_.up.name]
    return render(
        "losses.html",
        manifest=manifest,
        grid=" × ".join(f"{name} ({axis.num})" for name, axis in spec.named_axes.items()) + f", {spec.combine}",
        files=list(contents.files()),
        reasons=Counter(manifest.rejection_counts).most_common(),
        maps=maps,
        rejections=list(islice(contents.rejections(), LISTED)),
        side=240.0,
        margin=58.0,
    )
