"""Cars: hatchbacks, saloons, estates, SUVs, vans and pick-ups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from occdetr.streets.parts import (
    PLASTIC,
    Range,
    Trim,
    across,
    axles,
    lamps,
    make_trim,
    pick,
    slab,
)
from occdetr.streets.solids import PAINT, Material, Shape, Solid, box

CAR_PAINTS = (
    (0.72, 0.73, 0.75),
    (0.90, 0.90, 0.89),
    (0.86, 0.86, 0.86),
    (0.06, 0.06, 0.07),
    (0.10, 0.10, 0.11),
    (0.30, 0.31, 0.33),
    (0.48, 0.49, 0.51),
    (0.50, 0.05, 0.05),
    (0.68, 0.09, 0.07),
    (0.06, 0.12, 0.36),
    (0.16, 0.32, 0.58),
    (0.07, 0.22, 0.15),
    (0.55, 0.47, 0.34),
    (0.78, 0.62, 0.10),
)


class Style(NamedTuple):
    """Dimensions of a body style in metres, measured from the front or the rear end."""

    odds: float
    length: Range
    width: Range
    height: Range
    bonnet: float  # front end to the base of the windscreen
    rake: float  # horizontal length of the windscreen
    boot: float  # rear end to the base of the rear window
    rear_rake: float
    pillar: float  # the rear pillar's width
    clearance: float
    wheel: float  # radius


STYLES = {
    "hatchback": Style(
        0.34, (3.55, 4.3), (1.62, 1.8), (1.42, 1.54), 0.95, 0.75, 0.06, 0.42, 0.34, 0.19, 0.30
    ),
    "saloon": Style(
        0.20, (4.4, 4.95), (1.72, 1.86), (1.38, 1.47), 1.25, 0.82, 0.72, 0.62, 0.26, 0.18, 0.32
    ),
    "estate": Style(
        0.17, (4.4, 4.9), (1.7, 1.85), (1.43, 1.52), 1.2, 0.80, 0.06, 0.36, 0.20, 0.18, 0.32
    ),
    "suv": Style(
        0.14, (4.2, 4.85), (1.78, 1.95), (1.62, 1.78), 1.15, 0.62, 0.06, 0.26, 0.32, 0.26, 0.36
    ),
    "van": Style(
        0.11, (4.4, 5.3), (1.78, 1.98), (1.82, 2.05), 0.75, 0.70, 0.03, 0.12, 0.22, 0.22, 0.33
    ),
    "pick-up": Style(
        0.04, (4.9, 5.3), (1.78, 1.9), (1.7, 1.82), 1.15, 0.65, 1.75, 0.08, 0.10, 0.28, 0.38
    ),
}


def car(rng: np.random.Generator) -> Shape:
    """A car of a random style and colour: body, glazed cabin, roof, wheels, lights, plates."""
    names = list(STYLES)
    name = names[rng.choice(len(names), p=[style.odds for style in STYLES.values()])]
    style, trim = STYLES[name], make_trim("car", rng)
    length, width, height = (
        float(rng.uniform(*limits)) for limits in (style.length, style.width, style.height)
    )
    body = Material("car", pick(CAR_PAINTS, rng), PAINT)
    belt = 0.24 + 0.49 * height
    end, half = length / 2, width / 2
    cabin = (-end + style.boot, end - style.bonnet * length / (sum(style.length) / 2))
    panel_van = name == "van" and rng.random() < 0.5
    pillar = length - 2.6 if panel_van else style.pillar

    solids = [
        *_body(style, body, trim, (length, width), belt, cabin[1]),
        *_cabin(style, body, trim, cabin, half * 0.955, (belt, height), pillar),
        *_ends(style, body, trim, (length, width), belt, tall=name not in ("saloon", "pick-up")),
    ]
    if name in ("estate", "suv") and rng.random() < 0.6:
        rails = (cabin[0] + style.rear_rake, cabin[1] - style.rake - 0.1)
        solids.append(across(trim.rim, rails, half * 0.72, (height - 0.02, height + 0.03)))
    if name == "pick-up":
        solids += _bed(body, (-end + 0.06, cabin[0] + 0.05), half * 0.975, belt)
    return Shape((length + 0.04, width + 0.04), solids)


def _body(
    style: Style,
    body: Material,
    trim: Trim,
    size: tuple[float, float],
    belt: float,
    cowl: float,
) -> list[Solid]:
    """Everything below the windows: sills, flanks, bonnet, door gaps, wheels in their arches."""
    (length, width), nose = size, belt - 0.16
    end, half = length / 2, width / 2
    low, flank = style.clearance, style.clearance + 0.14
    rear = -end + 0.06
    back = (cowl - style.bonnet, rear)[style.boot < 1.0]  # a pick-up's bed is open
    axle = (-end + 0.19 * length, end - 0.185 * length)
    arch = style.wheel + 0.055
    door = 0.5 * sum(axle) + 0.12
    solids = [
        across(trim.plastic, (-end + 0.03, end - 0.03), half - 0.01, (low, flank)),
        across(body, (-end, end), half, (flank, 0.62)),
        slab(body, (-end, end), (-end + 0.03, end - 0.09), half, (0.62, nose)),
        slab(body, (back, end - 0.09), (back, cowl), half, (nose, belt), 0.965),
        *axles(trim, axle, width, style.wheel),
    ]
    for x in axle:
        bottom, top = (x - arch, x + arch), (x - 0.55 * arch, x + 0.55 * arch)
        solids.append(slab(trim.plastic, bottom, top, half + 0.003, (low, 2 * style.wheel + 0.05)))
    for x in (door, cowl - 0.1):
        solids.append(across(trim.plastic, (x - 0.01, x + 0.01), half + 0.003, (flank, nose)))
    return solids


def _cabin(
    style: Style,
    body: Material,
    trim: Trim,
    cabin: Range,
    half: float,
    z: Range,
    pillar: float,
) -> list[Solid]:
    """Glass all round, pillars on its flanks, a roof, mirrors."""
    (rear, cowl), (belt, height) = cabin, z
    taper, eaves = 0.83, height - 0.07
    top = (rear + style.rear_rake, cowl - style.rake)
    middle = 0.42 * rear + 0.58 * cowl - 0.2
    mirror = cowl - 0.15 / (eaves - belt) * style.rake - 0.03  # its arm is inside the glass

    def hoop(foot: float, head: float, wide: float, material: Material = body) -> Solid:
        limits = (foot, foot + wide), (head, head + wide)
        return slab(material, *limits, half + 0.012, (belt, eaves), taper)

    return [
        slab(trim.glass, cabin, top, half, (belt, eaves), taper),
        slab(
            body,
            (top[0] - 0.06, top[1] + 0.06),
            (top[0] + 0.06, top[1] - 0.12),
            half * taper + 0.02,
            (eaves - 0.01, height),
            0.88,
        ),
        hoop(rear + 0.05, top[0] + 0.03, pillar),
        hoop(middle - 0.05, middle - 0.1, 0.09, Material(body.class_name, PLASTIC)),
        hoop(cowl - 0.17, top[1] - 0.11, 0.09),
        across(body, (mirror - 0.1, mirror), half + 0.2, (belt + 0.03, belt + 0.15)),
    ]


def _ends(
    style: Style, body: Material, trim: Trim, size: tuple[float, float], belt: float, tall: bool
) -> list[Solid]:
    """Lights, grille, air intake, number plates."""
    (length, width), nose = size, belt - 0.16
    end, half = length / 2, width / 2
    low = style.clearance
    grille = (nose - 0.18, nose - 0.04)
    rear = (belt - (0.36 if tall else 0.26), belt - 0.05)
    return [
        *lamps(trim, trim.plastic, end - 0.045, half - 0.02, grille, 0.52 * half, 0.28),
        across(trim.plastic, (end - 0.2, end + 0.008), 0.6 * half, (low + 0.02, low + 0.16)),
        *lamps(trim, body, -end + 0.03, half - 0.02, rear, 0.7 * half, 0.16),
        across(trim.plate, (-end - 0.015, end + 0.015), 0.26, (low + 0.2, low + 0.31)),
    ]


def _bed(body: Material, x: Range, half: float, top: float) -> list[Solid]:
    """A pick-up's open bed: two flanks and a tailgate."""
    z = (0.6, top)
    return [
        box(body, x, (-half, 0.08 - half), z),
        box(body, x, (half - 0.08, half), z),
        across(body, (x[0], x[0] + 0.15), half, z),
    ]
