"""Measurement of certificates by the workers' program, whose build is certified.

The core is not imported here: the program returns two files.
"""

import os
import subprocess
import sys
from pathlib import Path

from pydantic import ValidationError
from stickslip_schemas.documents.certificate import Certificate, CertificateUpload

from stickslip_services.errors import CommandError

DOCUMENT_NAME = "certificate.json"
PAGE_NAME = "certificate.html"


class CertifyError(CommandError):
    """The certificate is missing, damaged, or could not be measured."""


def measure(preset: str, out: Path, *, quick: bool) -> Certificate:
    """Run the protocols of a preset and write the certificate into `out`; progress goes to standard error.

    Raises:
        CertifyError: The program failed, or `out` holds another certificate.
    """
    program = [sys.executable, "-m", "stickslip_workers", "certify"]
    arguments = ["--preset", preset, "--out", str(out), *(["--quick"] if quick else [])]
    # The matrices of master curves are too small for the threads of NumPy's linear algebra.
    environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ}
    try:
        ended = subprocess.run([*program, *arguments], env=environment, stdout=subprocess.PIPE, text=True, check=False)
    except OSError as error:
        raise CertifyError(f"the workers' program does not start: {error}") from error
    digest = ended.stdout.strip()
    if ended.returncode not in (0, 1) or not digest:
        raise CertifyError(f"no certificate was made: the workers' program ended with status {ended.returncode}")
    certificate = read_certificate(out).certificate
    if certificate.digest != digest:
        raise CertifyError(f"{out} holds another certificate than the one just made; is somebody else writing there?")
    return certificate


def read_certificate(directory: Path) -> CertificateUpload:
    """Read a certificate and its page from the directory that `measure` wrote; raise CertifyError."""
    try:
        certificate = Certificate.model_validate_json((directory / DOCUMENT_NAME).read_bytes())
        return CertificateUpload(certificate=certificate, page=(directory / PAGE_NAME).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CertifyError(f"{directory} holds no certificate: there is no {Path(error.filename).name}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the document"
        raise CertifyError(
            f"{directory / DOCUMENT_NAME} is not a valid certificate: {place}: {first['msg']}"
        ) from error
