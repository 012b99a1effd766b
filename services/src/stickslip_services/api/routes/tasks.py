"""Tasks, as a worker gets them: what `python -m stickslip_workers replay TASK.json` runs again."""

from typing import Annotated

from fastapi import APIRouter, Depends, Response

from stickslip_services.api.routes.common import coordinator_of, problem_responses
from stickslip_services.queue.compose import find_task
from stickslip_services.queue.coordinator import Coordinator

router = APIRouter(tags=["tasks"])

CoordinatorDep = Annotated[Coordinator, Depends(coordinator_of)]


@router.get(
    "/v1/tasks/{task_id}",
    response_class=Response,
    responses={
        200: {
            "description": "The task",
            "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Task"}}},
        },
        **problem_responses(404, 409),
    },
)
def get_task(task_id: str, coordinator: CoordinatorDep) -> Response:
    """Return a task as a worker gets it. 409: what it builds on is not there yet."""
    with coordinator.database.read() as connection:
        task = find_task(connection, task_id, coordinator.store.publish)
    return Response(task.model_dump_json(), media_type="application/json")
