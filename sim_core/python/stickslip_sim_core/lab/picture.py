"""A draped disc seen from above, as an SVG."""

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.lab.drape import DISC_RADIUS, PEDESTAL_RADIUS, Drape

SIZE = 480
"""Side of the picture [px]."""
LIGHT = np.array([-0.5, 0.5, 0.7])
"""Direction to the lamp; from above left."""
DARKEST = 60.0
BRIGHTEST = 235.0
"""Grey of cloth that faces away from the lamp, and towards it."""


def drape_svg(draped: Drape) -> str:
    """Return the draped disc as an SVG, with the outlines of the pedestal and of the flat disc."""
    half = 1.05 * DISC_RADIUS
    scale = SIZE / (2.0 * half)
    corners = draped.positions[draped.triangles]
    # What is higher hides what is lower: triangles are drawn from the lowest up.
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    pixels = np.stack([(corners[..., 0] + half) * scale, (half - corners[..., 1]) * scale], axis=-1)
    greys = _greys(corners)
    shapes = []
    for number in order:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels[number])
        grey = int(greys[number])
        colour = f"rgb({grey},{grey},{grey})"
        # The outline closes the hairlines between neighbours.
        shapes.append(f'<polygon points="{points}" fill="{colour}" stroke="{colour}"/>')
    title = f"{draped.fabric}: drape coefficient {draped.coefficient:.1f} %, {draped.folds} folds"
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE} {SIZE}" role="img">',
            f"<title>{_escaped(title)}</title>",
            f'<rect width="{SIZE}" height="{SIZE}" fill="white"/>',
            *shapes,
            _circle(PEDESTAL_RADIUS * scale, "#d0d0d0"),
            _circle(DISC_RADIUS * scale, "none"),
            "</svg>\n",
        ]
    )


def _greys(corners: Floats) -> Floats:
    """Return the grey of each triangle (T, 3, 3) by the angle to the lamp: (T,)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Both sides of cloth are seen, so the normal is turned up.
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    cosine = np.clip(normals @ LIGHT / (lengths * np.linalg.norm(LIGHT)), 0.0, 1.0)
    return np.asarray(DARKEST + (BRIGHTEST - DARKEST) * cosine)


def _circle(radius: float, fill: str) -> str:
    middle = SIZE / 2
    return (
        f'<circle cx="{middle:g}" cy="{middle:g}" r="{radius:.1f}" fill="{fill}" '
        'stroke="#c03020" stroke-dasharray="4 4"/>'
    )


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
