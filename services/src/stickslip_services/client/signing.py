"""Signatures of datasets.

A signature is that of `ssh-keygen -Y sign` over `manifest.sha256`, with the namespace `stickslip`.
OpenSSH does all cryptography and reads the keys; see ssh-keygen(1). The seal has the digests of the
manifest and of the root's metadata, which have those of all other files, so the signature covers
all of a version.
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

from stickslip_services.client.errors import (
    ChangedError,
    ClientError,
    DamagedError,
    UnknownSignerError,
    UnsignedError,
)

NAMESPACE = "stickslip"
"""Namespace of the signatures: a key that signs other things cannot be misused for datasets."""


def sign(seal: bytes, key: Path) -> bytes:
    """Return the signature of a seal.

    Raise ClientError if the key, private or of an agent, cannot sign.
    """
    process = _keygen("sign", "-n", NAMESPACE, "-f", str(key), data=seal)
    if process.returncode != 0:
        raise ClientError(f"{key} cannot sign: {_last_line(process)}")
    return process.stdout


def is_signature(signature: bytes, seal: bytes) -> bool:
    """Return whether a signature is one of a seal, by whatever key."""
    # ssh-keygen reads signatures from files only.
    with NamedTemporaryFile() as file:
        file.write(signature)
        file.flush()
        process = _keygen("check-novalidate", "-n", NAMESPACE, "-s", file.name, data=seal)
    return process.returncode == 0


def sign_directory(target: Path, key: Path) -> None:
    """Write the signature of the dataset in a directory.

    Raises:
        DamagedError: The seal is broken.
    """
    # A damaged dataset must not get a good signature.
    manifest = (target / MANIFEST_NAME).read_bytes()
    group = (target / GROUP_NAME).read_bytes()
    seal = (target / SEAL_NAME).read_bytes()
    try:
        check_seal(manifest, group, seal)
    except BrokenSealError as error:
        raise DamagedError(f"{target} is not signed, because it is damaged: {error}") from error
    write_durably(target / SIGNATURE_NAME, sign(seal, key))


def signer_of(target: Path, allowed_signers: Path) -> str:
    """Return the name of the signer of the dataset in a directory; files are not checked.

    Raises:
        ClientError: See `check_signature`.
    """
    try:
        signature = (target / SIGNATURE_NAME).read_bytes()
    except FileNotFoundError:
        signature = None
    return check_signature((target / SEAL_NAME).read_bytes(), signature, allowed_signers)


def check_signature(seal: bytes, signature: bytes | None, allowed_signers: Path) -> str:
    """Return the name of the signer of a seal.

    Args:
        seal: The signed bytes.
        signature: Their signature, if there is one.
        allowed_signers: File of the signers to trust [ssh-keygen(1)].

    Raises:
        UnsignedError: There is no signature.
        ChangedError: The signature is of another seal, or damaged.
        UnknownSignerError: The signature is good, and its key is not that of an allowed signer.
    """
    # A file that cannot be read is an error of its own, whatever the signature is.
    allowed_signers.open("rb").close()
    if signature is None:
        raise UnsignedError(f"the dataset is not signed: it has no {SIGNATURE_NAME}")
    with NamedTemporaryFile() as file:
        file.write(signature)
        file.flush()
        good = _keygen("check-novalidate", "-n", NAMESPACE, "-s", file.name, data=seal)
        if good.returncode != 0:
            raise ChangedError(
                f"the dataset or its signature was changed: {SIGNATURE_NAME} is no signature of "
                f"{SEAL_NAME} ({_last_line(good)})"
            )
        # Of the allowed signers with this key, one must have been allowed at the time.
        trusted = ("-f", str(allowed_signers), "-s", file.name)
        names = _keygen("find-principals", *trusted).stdout.decode().splitlines()
        for name in names:
            process = _keygen("verify", "-n", NAMESPACE, "-I", name, *trusted, data=seal)
            if process.returncode == 0:
                return name
    key = good.stdout.decode().strip().rpartition(" with ")[2]
    raise UnknownSignerError(
        f"the dataset was signed by somebody whom {allowed_signers} does not allow, with {key}"
    )


def _keygen(verb: str, *options: str, data: bytes = b"") -> "subprocess.CompletedProcess[bytes]":
    try:
        return subprocess.run(
            ["ssh-keygen", "-Y", verb, *options], input=data, capture_output=True, check=False
        )
    except FileNotFoundError as error:
        raise ClientError(
            "signatures need the program ssh-keygen, of OpenSSH 8.9 or newer"
        ) from error


def _last_line(process: "subprocess.CompletedProcess[bytes]") -> str:
    lines = process.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "ssh-keygen failed"
