"""Draw ``axes.svg`` and ``beams.svg`` beside this file: ``python docs/draw.py``.

Directions are those of the code: beams by ``beams_from_angles``, attitudes by
``R_lb_from_roll_pitch_heading``, so the drawings cannot say another thing.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.sensors.dvl import beams_from_angles

STYLE = """<style>
text { font: 14px system-ui, "DejaVu Sans", sans-serif; fill: #16202a; }
.small { font-size: 12px; fill: #4a5762; } .head { font-weight: 700; font-size: 15px; }
.line { stroke: #16202a; stroke-width: 2; fill: none; } .thin { stroke: #8a97a3; fill: none; }
.hull { fill: #dfe6ec; stroke: #16202a; stroke-width: 1.5; } .beam { stroke: #0b62a4; stroke-width: 3; }
.x { stroke: #a8001c; fill: none; stroke-width: 2.5; } .y { stroke: #00664b; fill: none; stroke-width: 2.5; }
.z { stroke: #0b62a4; fill: none; stroke-width: 2.5; } .dot { fill: #0b62a4; }
</style>"""
Point = tuple[float, float]


def arrow(begin: Point, end: Point, kind: str, label: str = "", shift: Point = (6.0, 5.0)) -> str:
    """Return an arrow with a word at its head."""
    angle = math.atan2(end[1] - begin[1], end[0] - begin[0])
    wings = [
        (end[0] - 11 * math.cos(angle + turn), end[1] - 11 * math.sin(angle + turn))
        for turn in (0.4, -0.4)
    ]
    (ax, ay), (bx, by) = wings
    path = f"M{begin[0]:.1f} {begin[1]:.1f}L{end[0]:.1f} {end[1]:.1f}"
    path += f"M{ax:.1f} {ay:.1f}L{end[0]:.1f} {end[1]:.1f}L{bx:.1f} {by:.1f}"
    return f'<path class="{kind}" d="{path}"/>' + text(
        (end[0] + shift[0], end[1] + shift[1]), label
    )


def text(at: Point, words: str, kind: str = "", anchor: str = "start") -> str:
    """Return a line of text."""
    if not words:
        return ""
    return f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" class="{kind}" text-anchor="{anchor}">{words}</text>'


def picture(width: int, height: int, title: str, parts: list[str]) -> str:
    """Return a drawing."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">'
    ground = f'<rect width="{width}" height="{height}" fill="#ffffff"/>'
    return "\n".join([head, f"<title>{title}</title>", STYLE, ground, *parts, "</svg>"]) + "\n"


def hull(centre: Point, heading: float, size: float = 46.0) -> str:
    """Return a vehicle from above, its bow along a heading, rad clockwise from up."""
    outline = [(1.25, 0.0), (0.7, 0.42), (-1.0, 0.42), (-1.0, -0.42), (0.7, -0.42)]
    places = []
    for forward, right in outline:
        x = forward * math.sin(heading) + right * math.cos(heading)
        y = -forward * math.cos(heading) + right * math.sin(heading)
        places.append(f"{centre[0] + size * x:.1f},{centre[1] + size * y:.1f}")
    return f'<polygon class="hull" points="{" ".join(places)}"/>'


def from_above(centre: Point) -> list[str]:
    """Draw east, north and a vehicle that heads 50 degrees, its axes by the code."""
    heading = math.radians(50.0)
    R_lb = R_lb_from_roll_pitch_heading(0.0, 0.0, heading)
    x, y = centre
    parts = [text((x - 135, 28), "Heading: clockwise from north", "head")]
    parts.append(hull(centre, heading))
    for axis, kind, label in ((0, "x", "x forward"), (1, "y", "y right (starboard)")):
        east, north, _ = R_lb[:, axis]
        shift = (6.0, 5.0) if axis == 0 else (-20.0, 18.0)
        parts.append(arrow(centre, (x + 105 * east, y - 105 * north), kind, label, shift))
    parts.append(f'<circle class="z" cx="{x}" cy="{y}" r="6"/>')
    parts.append(
        f'<path class="z" d="M{x - 4} {y - 4}L{x + 4} {y + 4}M{x - 4} {y + 4}L{x + 4} {y - 4}"/>'
    )
    parts.append(text((x - 40, y + 40), "z down", "small", "end"))
    corner = (x - 120.0, y + 118.0)
    parts.append(arrow(corner, (corner[0], corner[1] - 70), "line", "north", (-20.0, -8.0)))
    parts.append(arrow(corner, (corner[0] + 70, corner[1]), "line", "east"))
    parts.append(arrow(centre, (x, y - 100), "thin", ""))
    end = (x + 72 * math.sin(heading), y - 72 * math.cos(heading))
    parts.append(f'<path class="thin" d="M{x} {y - 72}A72 72 0 0 1 {end[0]:.1f} {end[1]:.1f}"/>')
    parts.append(text((x + 18, y - 78), "heading 50°", "small"))
    return parts


def from_the_side(centre: Point) -> list[str]:
    """Draw pitch: bow up is positive; up is against z."""
    x, y = centre
    R_lb = R_lb_from_roll_pitch_heading(0.0, math.radians(20.0), math.radians(90.0))
    forward, down = R_lb[:, 0], R_lb[:, 2]
    parts = [text((x - 135, 28), "Pitch: positive bow up", "head")]
    parts.append(
        f'<g transform="rotate(-20 {x} {y})"><rect class="hull" x="{x - 62}" y="{y - 15}" '
        f'width="118" height="30" rx="14"/></g>'
    )
    parts.append(arrow(centre, (x + 110 * forward[0], y - 110 * forward[2]), "x", "x forward"))
    parts.append(arrow(centre, (x + 80 * down[0], y - 80 * down[2]), "z", "z down"))
    parts.append(f'<path class="thin" d="M{x} {y}L{x + 130} {y}"/>')
    parts.append(text((x + 96, y - 10), "pitch 20°", "small"))
    parts.append(arrow((x - 120, y + 60), (x - 120, y - 10), "line", "up, height", (-4.0, -8.0)))
    return parts


def from_behind(centre: Point) -> list[str]:
    """Draw roll: starboard down is positive."""
    x, y = centre
    R_lb = R_lb_from_roll_pitch_heading(math.radians(20.0), 0.0, 0.0)
    right, down = R_lb[:, 1], R_lb[:, 2]
    parts = [text((x - 120, 28), "Roll: positive starboard down", "head")]
    parts.append(
        f'<g transform="rotate(20 {x} {y})"><rect class="hull" x="{x - 40}" y="{y - 24}" width="80" '
        f'height="48" rx="20"/></g>'
    )
    parts.append(arrow(centre, (x + 100 * right[0], y - 100 * right[2]), "y", "y right"))
    parts.append(arrow(centre, (x + 80 * down[0], y - 80 * down[2]), "z", "z down"))
    parts.append(f'<path class="thin" d="M{x} {y}L{x + 110} {y}"/>')
    parts.append(text((x + 74, y - 8), "roll 20°", "small"))
    return parts


def axes() -> str:
    """Return the drawing of frames and signs."""
    parts = [*from_above((160.0, 165.0)), *from_the_side((520.0, 150.0))]
    parts += from_behind((850.0, 150.0))
    parts.append(
        text(
            (360, 268),
            "Body axes FRD: forward, right, down. At rest and level an accelerometer reads",
            "small",
        )
    )
    parts.append(
        text(
            (360, 286),
            "(0, 0, −9.8) m/s²; a turn to starboard is a positive rate about z.",
            "small",
        )
    )
    return picture(1040, 310, "Axes and signs", parts)


def beams_of(
    centre: Point, title: str, azimuth_deg: list[float], janus_deg: float, note: str
) -> list[str]:
    """Draw where beams go, from above, numbered as in ``dvl.csv``."""
    x, y = centre
    parts = [text((x, 28), title, "head", "middle"), hull(centre, 0.0, 34.0)]
    directions = beams_from_angles(np.radians(azimuth_deg), math.radians(janus_deg))
    longest = max(float(np.hypot(*directions[:, :2].T).max()), 1e-9)
    for number, (forward, right, _) in enumerate(directions, start=1):
        ux, uy = right / longest, -forward / longest
        end = (x + 88 * ux, y + 88 * uy)
        parts.append(f'<path class="beam" d="M{x} {y}L{end[0]:.1f} {end[1]:.1f}"/>')
        parts.append(f'<circle class="dot" cx="{end[0]:.1f}" cy="{end[1]:.1f}" r="13"/>')
        parts.append(
            f'<text x="{end[0]:.1f}" y="{end[1] + 5:.1f}" text-anchor="middle" '
            f'style="fill:#fff;font-weight:700">{number}</text>'
        )
    parts.append(
        text(
            (x, y + 132), f"beam_azimuth_deg = {[round(a) for a in azimuth_deg]}", "small", "middle"
        )
    )
    parts.append(text((x, y + 150), note, "small", "middle"))
    return parts


def beams() -> str:
    """Return the drawing of the numbering of beams."""
    parts = [
        *beams_of((150.0, 160.0), "As in the examples", [45, 135, 225, 315], 30.0,
                  "clockwise from forward and starboard"),
        *beams_of((440.0, 160.0), "Blueye X3", [315, 45, 135, 225], 22.5,
                  "clockwise from forward and port"),
        *beams_of((730.0, 160.0), "Three beams", [0, 120, 240], 25.0, "one to eight beams, any order"),
    ]  # fmt: skip
    parts.append(arrow((905, 110), (905, 55), "x", "x forward"))
    parts.append(arrow((905, 110), (960, 110), "y", "y right", (-12.0, 20.0)))
    parts.append('<path class="line" d="M880 250L990 250"/>')
    parts.append(arrow((935, 175), (965, 248), "beam", ""))
    parts.append('<path class="thin" d="M935 175L935 248"/>')
    parts.append(text((905, 166), "from the side", "small"))
    parts.append(text((962, 222), "Janus angle", "small"))
    parts.append(text((880, 270), "from the vertical", "small"))
    return picture(1060, 325, "Numbers and directions of beams", parts)


def drawings() -> dict[str, str]:
    """Return every drawing by the name of its file."""
    return {"axes.svg": axes(), "beams.svg": beams()}


if __name__ == "__main__":
    for name, content in drawings().items():
        (Path(__file__).parent / name).write_text(content, encoding="utf-8")
