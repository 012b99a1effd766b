"""Certifying from the command line: the workers' own program measures, for it is their build that is certified.

Nothing of the core is imported here; what comes back are two files.
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
    """There is no certificate."""


def measure(preset: str, out: Path, *, quick: bool) -> Certificate:
    """Run the protocols of a preset, which tell of their progress on stderr; write the certificate into `out`."""
    program = [sys.executable, "-m", "stickslip_workers", "certify"]
    arguments = ["--preset", preset, "--out", str(out), *(["--quick"] if quick else [])]
    # Threads of NumPy's linear algebra only disturb: the matrices of master curves are small.
    environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ}
    try:
        ended = subprocess.run([*program, *arguments], env=environment, stdout=subprocess.PIPE, text=True, check=False)
    except OSError as error:
        raise CertifyError(f"the workers' program does not start: {error}") from error
    digest = ended.stdout.strip()
    if ended.returncode not in (0, 1) or not digest:
        raise CertifyError(f"there is no certificate: the workers' program ended with status {ended.returncode}")
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
        raise CertifyError(f"{directory / DOCUMENT_NAME} is no certificate: {place}: {first['msg']}") from error
