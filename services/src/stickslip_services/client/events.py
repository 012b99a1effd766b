"""Events of a job: server-sent events [WHATWG HTML, 9.2] as typed documents."""

import codecs
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from stickslip_schemas.documents import responses
from stickslip_schemas.transport.limits import EVENT_BYTES

from stickslip_services.client.answers import parse
from stickslip_services.client.errors import UnexpectedError

Event = (
    responses.JobStateEvent
    | responses.JobProgressEvent
    | responses.TaskStateEvent
    | responses.DatasetPublishedEvent
)

EVENT_MODELS: Mapping[str, type[Event]] = {
    responses.EventName.job_state: responses.JobStateEvent,
    responses.EventName.job_progress: responses.JobProgressEvent,
    responses.EventName.task_state: responses.TaskStateEvent,
    responses.EventName.dataset_published: responses.DatasetPublishedEvent,
}
"""Type of the document of each event."""

EVENT_NAMES: Mapping[type[Event], str] = {model: name for name, model in EVENT_MODELS.items()}
"""Name of the event of each type."""


class Message(NamedTuple):
    """One message of a stream."""

    id: str
    """Id to continue the stream from; empty if the message has none."""
    name: str
    """Name of the event; empty for a keep-alive."""
    data: str
    """The document as JSON."""


def read_messages(blocks: Iterable[bytes]) -> Iterator[Message]:
    """Yield the messages of a stream of bytes.

    Raises:
        UnexpectedError: A message does not end.
    """
    # A block may end within a character, and within a message.
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    pending = ""
    for block in blocks:
        # The last piece has no end yet.
        *messages, pending = (pending + decoder.decode(block)).split("\n\n")
        if len(pending) > EVENT_BYTES:
            raise UnexpectedError(f"the event stream sent an event of over {EVENT_BYTES} bytes")
        for message in messages:
            yield _read_message(message)


def _read_message(text: str) -> Message:
    fields: dict[str, str] = {}
    for line in text.split("\n"):
        # Comments, which keep the connection alive, have no name.
        name, _, value = line.partition(": ")
        fields[name] = value
    return Message(fields.get("id", ""), fields.get("event", ""), fields.get("data", ""))


def read_event(message: Message, url: str) -> Event | None:
    """Return the event of a message; None for one that only newer versions know.

    Raises:
        UnexpectedError: The data do not fit the event.
    """
    model = EVENT_MODELS.get(message.name)
    return None if model is None else parse(model, message.data.encode(), url)
