"""Certification: run the protocols of a preset with this build, and write the certificate.

It belongs to the workers because a certificate covers their build.
"""

import os
import platform
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from stickslip_schemas.base import canonical_json, content_key
from stickslip_schemas.documents.certificate import Certificate, ProtocolReport
from stickslip_schemas.plan.builds import digests, sources
from stickslip_schemas.store import write_durably
from stickslip_sim_core import build_info, protocols
from stickslip_sim_core.protocols import ProtocolResult
from stickslip_sim_core.protocols.result import dense_master

from stickslip_workers.builds import solver_build

DOCUMENT_NAME = "certificate.json"

Say = Callable[[str], None]


def certify(preset: str, out: Path, *, quick: bool, say: Say) -> Certificate:
    """Certify a preset: write `certificate.json` into `out`.

    A protocol that raises has not passed; the others run all the same. Raises ValueError for an unknown preset.
    """
    if preset not in protocols.CERTIFICATION:
        raise ValueError(f"preset: must be one of {', '.join(protocols.CERTIFICATION)}, got {preset!r}")
    certification = protocols.CERTIFICATION[preset]
    environment = _environment()
    reports: list[ProtocolReport] = []
    for number, name in enumerate(certification.protocols, 1):
        say(f"{number}/{len(certification.protocols)} {name} ...")
        cpu, wall = time.process_time(), time.monotonic()
        try:
            result = protocols.run(name, preset, **(certification.quick.get(name, {}) if quick else {}))
            report = ProtocolReport.model_validate(_with_dense_curves(result))
            canonical_json(report.model_dump(mode="json"))  # settings are free in form
        except Exception as error:  # any error becomes part of the certificate
            report = _broken_off(name, error)
        reports.append(report)
        spent = time.process_time() - cpu
        environment[f"cpu_seconds/{name}"] = f"{spent:.2f}"
        say(f"    {verdict(report)}; {spent:.1f} CPU s in {time.monotonic() - wall:.1f} s")
    certificate = Certificate(
        preset=preset,
        numbers=dict(certification.numbers()),
        sim_core=solver_build(certification.solver),
        protocol_sources=content_key("protocols", digests(sources(["stickslip_sim_core.protocols"]))),
        extent="quick" if quick else "full",
        protocols=tuple(reports),
        passed=all(report.passed for report in reports),
        environment=environment,
    )
    out.mkdir(parents=True, exist_ok=True)
    write_durably(out / DOCUMENT_NAME, certificate.canonical())
    return certificate


def verdict(report: ProtocolReport) -> str:
    if report.message:
        return f"broke off: {report.message}"
    error = "infinite" if report.error is None else f"{report.error:.1e}"
    return f"{'passed' if report.passed else 'FAILED'}, largest error {error} of {report.tolerance:g} allowed"


def _with_dense_curves(result: ProtocolResult) -> dict[str, Any]:
    document = result.as_dict()
    for shown, curve in zip(document["curves"], result.curves, strict=True):
        shown["dense_x"], shown["dense_master"] = (v.tolist() for v in dense_master(result.protocol, curve))
    return document


def _broken_off(name: str, error: Exception) -> ProtocolReport:
    return ProtocolReport(
        protocol=name,
        x="",
        y="",
        tolerance=0.0,
        error=None,
        passed=False,
        settings={},
        build_hash=build_info().build_hash,
        curves=(),
        message=f"{type(error).__name__}: {error}"[:2000],
    )


def _environment() -> dict[str, str]:
    build = build_info()
    return {
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "load": f"{os.getloadavg()[0]:.1f}",
        "python": platform.python_version(),
        "numpy": metadata.version("numpy"),
        "sim_core": build.version,
        "compiler": build.compiler,
        "isa": build.isa,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
