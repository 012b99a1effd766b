"""Certification: run the protocols of a preset with this build, and write the certificate and its page.

It belongs to the workers because a certificate covers their build.
"""

import base64
import io
import os
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jinja2
from stickslip_schemas.base.keys import canonical_json, content_key
from stickslip_schemas.documents.certificate import Certificate, ProtocolReport
from stickslip_schemas.plan.sources import digests, sources
from stickslip_schemas.store import write_durably
from stickslip_sim_core import build_info, protocols
from stickslip_sim_core.protocols import ProtocolResult
from stickslip_sim_core.protocols.plots import dense_master

from stickslip_workers.builds import solver_build

DOCUMENT_NAME = "certificate.json"
PAGE_NAME = "certificate.html"

Say = Callable[[str], None]


def certify(preset: str, out: Path, *, quick: bool, say: Say) -> Certificate:
    """Certify a preset: write `certificate.json` and `certificate.html` into `out`.

    A protocol that raises has not passed; the others run all the same.

    Raises:
        ValueError: There is no such preset.
        ModuleNotFoundError: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:  # fail now, not after an hour of protocols
        raise ModuleNotFoundError("certificates have pictures: pip install 'stickslip-sim-core[plots]'")
    if preset not in protocols.CERTIFICATION:
        raise ValueError(f"preset: must be one of {', '.join(protocols.CERTIFICATION)}, got {preset!r}")
    certification = protocols.CERTIFICATION[preset]
    environment = _environment()
    reports: list[ProtocolReport] = []
    results: list[ProtocolResult] = []
    for number, name in enumerate(certification.protocols, 1):
        say(f"{number}/{len(certification.protocols)} {name} ...")
        cpu, wall = time.process_time(), time.monotonic()
        try:
            result = protocols.run(name, preset, **(certification.quick.get(name, {}) if quick else {}))
            report = ProtocolReport.model_validate(_with_dense_curves(result))
            canonical_json(report.model_dump(mode="json"))  # settings are free in form
        except Exception as error:  # any error becomes part of the certificate
            report = _broken_off(name, error)
        else:
            results.append(result)
        reports.append(report)
        spent = time.process_time() - cpu
        environment[f"cpu_seconds/{name}"] = f"{spent:.2f}"
        say(f"    {verdict(report)}; {spent:.1f} CPU s in {time.monotonic() - wall:.1f} s")
    certificate = Certificate(
        preset=preset,
        numbers=dict(certification.numbers()),
        sim_core=solver_build(certification.solver),
        protocol_sources=_protocol_sources(),
        extent="quick" if quick else "full",
        protocols=tuple(reports),
        passed=all(report.passed for report in reports),
        environment=environment,
    )
    out.mkdir(parents=True, exist_ok=True)
    write_durably(out / DOCUMENT_NAME, certificate.canonical())
    write_durably(out / PAGE_NAME, _page(certificate, results).encode())
    return certificate


def verdict(report: ProtocolReport) -> str:
    """Return the outcome of a protocol in words."""
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


def _protocol_sources() -> str:
    """Return the digest of the protocols and their master curves."""
    return content_key("protocols", digests(sources(["stickslip_sim_core.protocols"])))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _page(certificate: Certificate, results: Sequence[ProtocolResult]) -> str:
    """Return the page: one HTML file that contains its pictures, drawn from the results by matplotlib."""
    import matplotlib
    from stickslip_sim_core.protocols import plots

    pictures: dict[str, list[str]] = defaultdict(list)
    undrawn: dict[str, str] = {}
    with matplotlib.rc_context({"svg.hashsalt": "stickslip", "svg.fonttype": "path"}):
        for result in results:
            try:
                for figure in plots.figures(result):
                    data = io.BytesIO()
                    figure.savefig(data, format="svg", metadata={"Date": None})
                    # As an image: several SVG elements in one page would share their ids.
                    pictures[result.protocol].append(base64.b64encode(data.getvalue()).decode())
            except Exception as error:  # a missing picture must not lose the measurements
                undrawn[result.protocol] = f"{type(error).__name__}: {error}"
    environment = jinja2.Environment(autoescape=True, loader=jinja2.PackageLoader("stickslip_workers", ""))
    environment.filters["shown"] = _shown
    page = environment.get_template("certificate.html")
    return page.render(certificate=certificate, pictures=pictures, undrawn=undrawn)


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_shown(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
