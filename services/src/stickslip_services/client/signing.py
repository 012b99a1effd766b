"""Signatures of datasets: `ssh-keygen -Y sign` over `manifest.sha256`, with the namespace `stickslip`.

OpenSSH does all cryptography and reads the keys; see ssh-keygen(1). The seal has the digests of the manifest and of the
root's metadata, which have those of all other files, so the signature covers all of a version.
"""

import subprocess
from pathlib import Path
from tempfile import NamedTemporaryFile

from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    SIGNATURE_NAME,
    BrokenSealError,
    check_seal,
)
from stickslip_schemas.store import write_durably

from stickslip_services.client.errors import ChangedError, ClientError, DamagedError, UnknownSignerError, UnsignedError

NAMESPACE = "stickslip"


def sign(seal: bytes, key: Path) -> bytes:
    """Return the signature of a seal; raise ClientError if the key, private or of an agent, cannot sign."""
    ended = _keygen("sign", "-n", NAMESPACE, "-f", str(key), data=seal)
    if ended.returncode != 0:
        raise ClientError(f"{key} cannot sign: {_last_line(ended)}")
    return ended.stdout


def is_signature(signature: bytes, seal: bytes) -> bool:
    with NamedTemporaryFile() as file:
        file.write(signature)
        file.flush()
        return _keygen("check-novalidate", "-n", NAMESPACE, "-s", file.name, data=seal).returncode == 0


def sign_directory(target: Path, key: Path) -> None:
    """Write the signature of the dataset in a directory; raise DamagedError if the seal is broken."""
    manifest, group, seal = ((target / name).read_bytes() for name in (MANIFEST_NAME, GROUP_NAME, SEAL_NAME))
    try:
        check_seal(manifest, group, seal)
    except BrokenSealError as error:
        raise DamagedError(f"{target} is not signed, because it is damaged: {error}") from error
    write_durably(target / SIGNATURE_NAME, sign(seal, key))


def signer_of(target: Path, allowed_signers: Path) -> str:
    """Return who signed the dataset in a directory; raise what `check_signature` raises. Files are not checked."""
    try:
        signature = (target / SIGNATURE_NAME).read_bytes()
    except FileNotFoundError:
        signature = None
    return check_signature((target / SEAL_NAME).read_bytes(), signature, allowed_signers)


def check_signature(seal: bytes, signature: bytes | None, allowed_signers: Path) -> str:
    """Return who of a file of allowed signers [ssh-keygen(1)] signed a seal.

    Raises:
        UnsignedError: There is no signature.
        ChangedError: The signature is of another seal, or damaged.
        UnknownSignerError: The signature is good, and its key is not that of an allowed signer.
    """
    allowed_signers.open("rb").close()
    if signature is None:
        raise UnsignedError(f"the dataset is not signed: it has no {SIGNATURE_NAME}")
    with NamedTemporaryFile() as file:
        file.write(signature)
        file.flush()
        good = _keygen("check-novalidate", "-n", NAMESPACE, "-s", file.name, data=seal)
        if good.returncode != 0:
            raise ChangedError(
                f"the dataset or its signature was changed: {SIGNATURE_NAME} is no signature of {SEAL_NAME} "
                f"({_last_line(good)})"
            )
        trusted = "-f", str(allowed_signers), "-s", file.name
        names = _keygen("find-principals", *trusted).stdout.decode().splitlines()
        for name in names:
            if _keygen("verify", "-n", NAMESPACE, "-I", name, *trusted, data=seal).returncode == 0:
                return name
    key = good.stdout.decode().strip().rpartition(" with ")[2]
    raise UnknownSignerError(f"the dataset was signed by somebody whom {allowed_signers} does not allow, with {key}")


def _keygen(verb: str, *options: str, data: bytes = b"") -> "subprocess.CompletedProcess[bytes]":
    try:
        return subprocess.run(["ssh-keygen", "-Y", verb, *options], input=data, capture_output=True, check=False)
    except FileNotFoundError as error:
        raise ClientError("signatures need the program ssh-keygen, of OpenSSH 8.9 or newer") from error


def _last_line(ended: "subprocess.CompletedProcess[bytes]") -> str:
    return (ended.stderr.decode(errors="replace").strip().splitlines() or ["ssh-keygen failed"])[-1]
