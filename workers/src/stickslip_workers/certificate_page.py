"""The page of a certificate: one HTML file with everything in it."""

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from stickslip_schemas.documents.certificate import Certificate, CurveReport, ProtocolReport
from stickslip_sim_core.protocols import ProtocolResult

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 0.5rem 0 1rem; }
th, td { text-align: left; padding: 0.15rem 1rem 0.15rem 0; border-bottom: 1px solid #ddd; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
code { font-size: 0.9em; overflow-wrap: anywhere; }
img { max-width: 100%; }
.passed { color: #00663f; } .failed { color: #b00020; }
"""


def certificate_page(certificate: Certificate, results: Sequence[ProtocolResult]) -> str:
    """Return the page; pictures are drawn from the results (which needs matplotlib)."""
    pictures = {result.protocol: _pictures(result) for result in results}
    title = f"Certificate of preset {certificate.preset}"
    parts = [
        f"<h1>{escape(title)}: {_mark(certificate.passed)}</h1>",
        "<p>What this build of the simulator measures on physical protocols, against their master curves.</p>",
    ]
    if certificate.extent == "quick":
        parts.append('<p class="failed">A quick run over a few points: it does not count as a certificate.</p>')
    parts += [
        _facts(
            {
                "digest": certificate.digest,
                "build of sim_core": certificate.sim_core,
                "compiled core": certificate.protocols[0].build_hash,
            }
        ),
        _summary(certificate.protocols),
    ]
    if certificate.numbers:
        parts += ["<h2>Numbers of the preset</h2>", _facts(certificate.numbers)]
    for report in certificate.protocols:
        parts += [f"<h2>{escape(report.protocol)}: {_mark(report.passed)}</h2>", *pictures.get(report.protocol, ())]
        if report.message:
            parts.append(f"<p>It broke off: <code>{escape(report.message)}</code></p>")
        if report.settings:
            parts.append(_facts(report.settings))
        parts += [_curve(report, curve) for curve in report.curves]
    parts += ["<h2>Where it was made</h2>", _facts(certificate.environment)]
    body = "\n".join(parts)
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{_STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _mark(passed: bool) -> str:
    return '<span class="passed">passed</span>' if passed else '<span class="failed">failed</span>'


def _facts(values: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{escape(str(name))}</th><td><code>{escape(_shown(value))}</code></td></tr>"
        for name, value in values.items()
    )
    return f"<table>{rows}</table>"


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_shown(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _summary(reports: Sequence[ProtocolReport]) -> str:
    rows = "".join(
        f"<tr><td>{escape(report.protocol)}</td>{_number(report.error, '.2e')}{_number(report.tolerance, '.2g')}"
        f"<td>{_mark(report.passed)}</td></tr>"
        for report in reports
    )
    return f"<table><tr><th>protocol</th><th>largest error</th><th>allowed</th><th></th></tr>{rows}</table>"


def _curve(report: ProtocolReport, curve: CurveReport) -> str:
    fixed = ", ".join(f"{name} = {value:g}" for name, value in curve.parameters.items())
    head = "".join(f"<th>{escape(name)}</th>" for name in (report.x, f"{report.y}, measured", "master curve", "error"))
    rows = "".join(
        f"<tr>{_number(x, '.6g')}{_number(measured, '.9g')}{_number(master, '.9g')}{_number(error, '.1e')}</tr>"
        for x, measured, master, error in zip(curve.x, curve.measured, curve.master, curve.errors, strict=True)
    )
    return f"<details><summary>{escape(fixed) or 'numbers'}</summary><table><tr>{head}</tr>{rows}</table></details>"


def _number(value: float | None, form: str) -> str:
    return f'<td class="number">{"none" if value is None else format(value, form)}</td>'


def _pictures(result: ProtocolResult) -> list[str]:
    """Return the figures of a result as images whose data is in the page: several SVGs would share their ids."""
    import matplotlib
    from stickslip_sim_core.protocols import plots

    images: list[str] = []
    with matplotlib.rc_context({"svg.hashsalt": "stickslip", "svg.fonttype": "path"}):
        try:
            for figure in plots.figures(result):
                data = io.BytesIO()
                figure.savefig(data, format="svg", metadata={"Date": None})
                text = base64.b64encode(data.getvalue()).decode()
                images.append(f'<img alt="{escape(result.protocol)}" src="data:image/svg+xml;base64,{text}">')
        except Exception as error:  # what was measured is not lost for want of a picture
            images.append(
                f"<p>A picture could not be drawn: <code>{escape(f'{type(error).__name__}: {error}')}</code></p>"
            )
    return images
