"""Pages of scenes: the list, and one scene."""

from fastapi import APIRouter, Response

from stickslip_services.api.html import html_page
from stickslip_services.api.routes.common import ContextDep
from stickslip_services.catalog.scenes import known_scenes
from stickslip_services.errors import NotFoundError

router = APIRouter()


@router.get("/scenes")
def get_scenes(context: ContextDep) -> Response:
    """Show the scenes."""
    with context.database.read() as connection:
        scenes = known_scenes(connection)
    return html_page("scenes.html", here="scenes", scenes=scenes)


@router.get("/scenes/{digest}")
def get_scene(digest: str, context: ContextDep) -> Response:
    """Show a scene: how it looks, its parameters, and the datasets made of it."""
    with context.database.read() as connection:
        known = known_scenes(connection).get(digest)
    if known is None:
        raise NotFoundError(f"there is no scene {digest[:64]!r}")
    return html_page("scene.html", here="scenes", known=known, scene=known.scene)
