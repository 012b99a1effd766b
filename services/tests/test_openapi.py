"""The committed OpenAPI document is the one that the code serves, and it is true."""

import json
from functools import cache
from pathlib import Path

from stickslip_services.app import openapi_text

generated = cache(openapi_text)

COMMITTED = Path(__file__).parents[2] / "docs" / "openapi.json"


def test_the_committed_document_is_up_to_date() -> None:
    assert COMMITTED.read_text() == generated(), (
        "run: python -m stickslip_services.app --openapi > docs/openapi.json"
    )


def test_every_reference_leads_somewhere() -> None:
    document = json.loads(generated())
    names = set(document["components"]["schemas"])
    text = json.dumps(document)
    references = {part.split('"')[0] for part in text.split("#/components/schemas/")[1:]}
    assert references - names == set()
    assert "HTTPValidationError" not in text
    assert "#/$defs/" not in text


def test_every_route_names_its_problems() -> None:
    document = json.loads(generated())
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            for status, response in operation["responses"].items():
                if int(status) >= 400:
                    assert list(response["content"]) == ["application/problem+json"], (
                        method,
                        path,
                        status,
                    )
