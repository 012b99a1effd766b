"""Routes of health checks and metrics."""

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from sqlalchemy import text
from stickslip_schemas.base import Document

from stickslip_services import __version__
from stickslip_services.access.asker import refuse_projects
from stickslip_services.api.metrics import Metrics
from stickslip_services.api.routes.common import ContextDep, problem_responses

router = APIRouter(tags=["health"])


class Health(Document):
    """The coordinator answers."""

    version: str


@router.get("/livez")
async def get_livez() -> Health:
    """Answer: the process is alive."""
    return Health(version=__version__)


@router.get("/readyz", responses=problem_responses())
def get_readyz(context: ContextDep) -> Health:
    """Answer: the database can be read. 503 where it cannot."""
    with context.database.read() as connection:
        connection.execute(text("SELECT seq FROM jobs LIMIT 1"))
    return Health(version=__version__)


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {"description": "Metrics", "content": {"text/plain": {"schema": {"type": "string"}}}},
        **problem_responses(404),
    },
)
def get_metrics(request: Request) -> Response:
    """Return metrics for Prometheus. 404: the key belongs to a project."""
    refuse_projects("metrics")
    metrics: Metrics = request.app.state.metrics
    return Response(metrics.text(), headers={"Content-Type": CONTENT_TYPE_LATEST})
