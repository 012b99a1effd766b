"""The command that uploads custom textures."""

from pathlib import Path
from typing import Annotated

import typer

from stickslip_services.addresses import DEFAULT_URL
from stickslip_services.cli.common import JsonOption, UrlOption, console, print_json, say
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.errors import ClientError
from stickslip_services.client.http import Client


@shows_errors
def upload(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="square PNG or JPEG files")],
    url: UrlOption = DEFAULT_URL,
    as_json: JsonOption = False,
) -> None:
    """Upload pictures as textures, and print their entries for `textures` in a spec."""
    found = []
    with Client(url) as client:
        for file in files:
            try:
                data = file.read_bytes()
            except OSError as error:
                raise ClientError(f"{file} cannot be read: {error.strerror or error}") from error
            try:
                found.append(client.upload_texture(data))
            except ClientError as error:
                raise ClientError(f"{file} was refused: {error}") from error
    if as_json:
        return print_json(found)
    say("In a spec, under any names:")
    console().print("textures:")
    for file, entry in zip(files, found, strict=True):
        console().print(f"  {_name(file)}: {entry.texture}")
    return None


def _name(file: Path) -> str:
    """Return the name of a texture, from the name of its file."""
    word = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in file.stem.lower())
    return word.strip("-")[:60] or "custom"
