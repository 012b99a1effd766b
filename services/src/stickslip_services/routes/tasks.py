"""Tasks, as a worker gets them: what `python -m stickslip_workers replay TASK.json` runs again."""

from fastapi import APIRouter, Response

from stickslip_services.routes.common import CoordinatorDep, problem_responses

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
def get_task(task_id: str, coordinator: CoordinatorDep) -> Response:
    """Return a task as a worker gets it. 409: what it builds on is not there yet."""
    return Response(coordinator.show_task(task_id).model_dump_json(), media_type="application/json")
