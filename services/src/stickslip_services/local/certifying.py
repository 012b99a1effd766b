"""Measurement of certificates by the workers' program, whose build is certified.

The core is not imported here: the program writes a file.
"""

import os
import subprocess
import sys
from pathlib import Path

from pydantic import ValidationError
from stickslip_schemas.documents.certificate import Certificate

from stickslip_services.errors import CommandError

DOCUMENT_NAME = "certificate.json"


class CertifyError(CommandError):
    """The certificate is missing, damaged, or could not be measured."""


def ask_workers(arguments: list[str], refusal: str, sort: type[CommandError]) -> str:
    """Run the workers' program and return what it printed; raise an error of a sort where it made nothing."""
    # The matrices of master curves are too small for the threads of NumPy's linear algebra.
    environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ}
    command = [sys.executable, "-m", "stickslip_workers", *arguments]
    try:
        ended = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    except OSError as error:
        raise sort(f"the workers' program does not start: {error}") from error
    if ended.returncode not in (0, 1) or not ended.stdout.strip():
        raise sort(f"{refusal}: the workers' program ended with status {ended.returncode}")
    return ended.stdout


def measure(preset: str, out: Path, *, quick: bool) -> Certificate:
    """Run the protocols of a preset and write the certificate into `out`; progress goes to standard error.

    Raises:
        CertifyError: The program failed, or `out` holds another certificate.
    """
    arguments = ["certify", "--preset", preset, "--out", str(out), *(["--quick"] if quick else [])]
    digest = ask_workers(arguments, "no certificate was made", CertifyError).strip()
    certificate = read_certificate(out)
    if certificate.digest != digest:
        raise CertifyError(f"{out} holds another certificate than the one just made; is somebody else writing there?")
    return certificate


def read_certificate(directory: Path) -> Certificate:
    """Read a certificate from the directory that `measure` wrote; raise CertifyError."""
    try:
        return Certificate.model_validate_json((directory / DOCUMENT_NAME).read_bytes())
    except FileNotFoundError as error:
        raise CertifyError(f"{directory} holds no certificate: there is no {DOCUMENT_NAME}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the document"
        raise CertifyError(
            f"{directory / DOCUMENT_NAME} is not a valid certificate: {place}: {first['msg']}"
        ) from error
