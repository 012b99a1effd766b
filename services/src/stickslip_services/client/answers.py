"""Answers of a coordinator: problems as exceptions, documents as typed values, text made printable.

A server may be hostile or broken. Text that could steer a terminal is written out before a program
or a person gets it.
"""

import json
import re
import unicodedata
from typing import TypeVar

import httpx
from pydantic import JsonValue, TypeAdapter, ValidationError
from stickslip_schemas.documents.problems import MEDIA_TYPE, Problem
from stickslip_schemas.transport.addresses import without_password
from stickslip_schemas.transport.limits import check_values
from stickslip_schemas.transport.proxies import through

from stickslip_services.client.errors import ProblemError, UnexpectedError

T = TypeVar("T")

_STEERS = ("Cc", "Cf", "Zl", "Zp")
"""Unicode categories of characters that move the cursor, colour, hide or turn text."""

_SUSPICIOUS = re.compile(rb"\\[ubfr]|[\x7f-\xff]")
"""Bytes of JSON that may stand for such a character: escapes, and all that is not ASCII."""


def printable(text: str) -> str:
    """Return text with every character that steers a terminal written out, as in `\\x1b`.

    Line breaks and tabs become spaces, so that one message stays on one line.
    """
    characters = []
    for character in text:
        if character in "\n\r\t":
            characters.append(" ")
        elif unicodedata.category(character) in _STEERS:
            characters.append(f"\\x{ord(character):02x}")
        else:
            characters.append(character)
    return "".join(characters)


def printable_json(content: bytes) -> bytes:
    """Return a JSON document whose strings are printable; most documents are already."""
    # A manifest has megabytes, and parsing it twice would take a second.
    if _SUSPICIOUS.search(content) is None:
        return content
    try:
        document = json.loads(content)
    except (ValueError, RecursionError):
        return content  # the model will refuse it
    return json.dumps(_printable_value(document)).encode()


def _printable_value(value: JsonValue) -> JsonValue:
    """Return a JSON value whose strings, but for line breaks, are printable."""
    if isinstance(value, str):
        return "\n".join(printable(line) for line in value.split("\n"))
    if isinstance(value, list):
        return [_printable_value(item) for item in value]
    if isinstance(value, dict):
        return {printable(key): _printable_value(item) for key, item in value.items()}
    return value


def parse(model: type[T], content: bytes, url: str) -> T:
    """Return the document of an answer.

    Args:
        model: Type of the document.
        content: Body of the answer, JSON.
        url: Where it came from, for the message.

    Raises:
        UnexpectedError: The content is not such a document.
    """
    try:
        check_values(content)
    except ValueError as error:
        raise UnexpectedError(f"the document of {without_password(url)} {error}") from error
    try:
        return TypeAdapter(model).validate_json(printable_json(content))
    except ValidationError as error:
        raise UnexpectedError(
            f"{without_password(url)} sent an unexpected answer: {first_fault(error)}"
        ) from error


def first_fault(error: ValidationError) -> str:
    """Return the first field that breaks a rule, and the rule, without the value."""
    # Values are left out: they are a server's, and may be long.
    fault = error.errors(include_url=False, include_input=False)[0]
    field = ".".join(str(part) for part in fault["loc"]) or "the document"
    return printable(f"{field}: {fault['msg']}")


def raise_for_problem(response: httpx.Response) -> None:
    """Raise an error unless an answer, whose body has been read, reports success.

    Raises:
        ProblemError: The coordinator refused the request.
        UnexpectedError: The answer is not that of a coordinator.
    """
    if response.is_success:
        return
    url = without_password(str(response.url))
    # A proxy or another program answers with a page of its own, which is not a problem document.
    if response.headers.get("content-type", "").startswith(MEDIA_TYPE):
        raise ProblemError(parse(Problem, response.content, url))
    raise UnexpectedError(
        f"{url} answered with status {response.status_code}{through(url)}; is it a coordinator?"
    )
