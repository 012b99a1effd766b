"""Tasks, as a worker gets them: what `python -m stickslip_workers replay TASK.json` runs again."""

from fastapi import APIRouter, Response

from stickslip_services.api.routes.common import ContextDep, problem_responses
from stickslip_services.queue.compose import find_task

router = APIRouter(tags=["tasks"])


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
def get_task(task_id: str, context: ContextDep) -> Response:
    """Return a task as a worker gets it. 409: what it builds on is not there yet."""
    with context.database.read() as connection:
        task = find_task(connection, task_id, context.store.publish)
    return Response(task.model_dump_json(), media_type="application/json")
