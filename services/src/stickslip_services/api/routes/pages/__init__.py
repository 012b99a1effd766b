"""Pages for people: the dashboard at `/`. They are not part of the API and may change at any time."""

from fastapi import APIRouter

from stickslip_services.api.routes.pages import datasets, jobs

router = APIRouter(include_in_schema=False)
for _module in (jobs, datasets):
    router.include_router(_module.router)
