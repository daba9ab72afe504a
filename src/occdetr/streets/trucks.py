"""Lorries: a cab over the engine with a box, a flatbed, a tipper or a semi-trailer."""

from __future__ import annotations

import numpy as np

from occdetr.streets.parts import Trim, across, axles, ball, lamps, make_trim, paint, slab
from occdetr.streets.solids import PAINT, Material, Shape, Solid

CABS = (
    (0.88, 0.88, 0.87),
    (0.62, 0.08, 0.07),
    (0.08, 0.20, 0.50),
    (0.85, 0.45, 0.08),
    (0.10, 0.32, 0.18),
    (0.80, 0.66, 0.12),
    (0.30, 0.32, 0.35),
)
LOADS = ((0.88, 0.88, 0.86), (0.60, 0.62, 0.64), (0.80, 0.78, 0.70), (0.20, 0.33, 0.55))
CARGOES = ((0.52, 0.40, 0.26), (0.45, 0.44, 0.42), (0.60, 0.34, 0.24), (0.35, 0.42, 0.30))


def truck(rng: np.random.Generator) -> Shape:
    """A lorry: a cab over the engine, and a box, a flatbed, a tipper or a semi-trailer."""
    kind = ("box", "flatbed", "tipper", "articulated")[rng.choice(4, p=(0.45, 0.2, 0.15, 0.2))]
    length = float(rng.uniform(9.5, 12.0) if kind == "articulated" else rng.uniform(5.8, 8.6))
    width, cab = float(rng.uniform(2.15, 2.5)), float(rng.uniform(1.6, 2.0))
    height, radius = float(rng.uniform(2.45, 2.85)), float(rng.uniform(0.42, 0.5))
    end, half, trim = length / 2, width / 2, make_trim("truck", rng)
    load, top = (-end, end - cab - 0.25), float(rng.uniform(3.0, 3.6))
    solids = [
        *_cab(trim, paint("truck", CABS, rng, PAINT), end, cab, half, height),
        across(trim.plastic, (-end + 0.05, end - 0.3), 0.45, (0.55, 0.95)),
        across(trim.plate, (-end - 0.02, end + 0.06), 0.26, (0.42, 0.54)),
        *lamps(trim, trim.plastic, -end, half - 0.03, (0.72, 0.88), 0.62 * half, 0.1),
        across(trim.rim, (load[0] + 0.35 * length, load[1] - 1.3), half - 0.06, (0.5, 0.85)),
    ]
    front = end - 0.62 * cab
    rear = -end + 0.2 * length
    if kind == "articulated":
        solids += axles(trim, (front, front - 3.0), width, radius, 0.3)
        solids += axles(trim, (-end + 1.2, -end + 2.3), width, radius, 0.3)
    else:
        solids += axles(trim, (front, rear), width, radius, 0.3)
    if kind in ("box", "articulated"):
        solids += _box_body(rng, trim, load, half, top)
    elif kind == "flatbed":
        solids += _flatbed(rng, trim, load, half)
    else:
        solids += _tipper(rng, load, half)
    return Shape((length + 0.1, width + 0.05), solids)


def _cab(
    trim: Trim, body: Material, end: float, length: float, half: float, height: float
) -> list[Solid]:
    """A cab over the engine: glazed upper half, grille, bumper with lights, mirrors."""
    rear, belt, eaves = end - length, 0.53 * height, 0.86 * height
    axle = end - 0.62 * length
    arch = (axle - 0.6, axle + 0.6), (axle - 0.4, axle + 0.4)
    return [
        across(body, (rear, end), half, (0.5, belt)),
        slab(trim.glass, (rear, end), (rear, end - 0.12), half - 0.025, (belt, eaves), 0.97),
        slab(body, (rear, end - 0.06), (rear, end - 0.36), half, (eaves - 0.03, height), 0.9),
        slab(body, (rear, end - 1.15), (rear, end - 1.15), half - 0.01, (belt, eaves), 0.97),
        slab(
            body, (end - 0.2, end - 0.09), (end - 0.3, end - 0.2), half - 0.01, (belt, eaves), 0.97
        ),
        across(trim.plastic, (end - 0.2, end + 0.015), 0.68 * half, (0.82, belt - 0.12)),
        across(trim.plastic, (end - 0.5, end + 0.04), half + 0.01, (0.36, 0.76)),
        *lamps(trim, trim.plastic, end + 0.04, half, (0.52, 0.67), 0.6 * half, 0.12),
        across(trim.plastic, (end - 0.36, end - 0.24), half + 0.24, (belt + 0.1, eaves - 0.12)),
        slab(trim.plastic, *arch, half + 0.003, (0.5, 1.05)),
    ]


def _box_body(
    rng: np.random.Generator, trim: Trim, x: tuple[float, float], half: float, top: float
) -> list[Solid]:
    """A closed box with a coloured band, metal edges, and a gap between its doors."""
    body, band = paint("truck", LOADS, rng), paint("truck", CABS, rng)
    low = float(rng.uniform(1.3, 1.8))
    wide = (x[0] + 0.6, x[1] - 0.6)
    return [
        across(body, x, half, (0.95, top)),
        across(band, wide, half + 0.01, (low, low + float(rng.uniform(0.3, 0.8)))),
        across(trim.rim, (x[0] - 0.012, x[1] + 0.012), half + 0.012, (0.92, 1.06)),
        across(trim.rim, (x[0] - 0.012, x[1] + 0.012), half + 0.012, (top - 0.1, top + 0.01)),
        across(trim.plastic, (x[0] - 0.014, x[0] + 0.1), 0.02, (1.06, top - 0.1)),
    ]


def _flatbed(
    rng: np.random.Generator, trim: Trim, x: tuple[float, float], half: float
) -> list[Solid]:
    """A bed with low sides and a headboard, empty or with crates or a heap."""
    sides = paint("truck", LOADS, rng)
    solids = [
        across(sides, x, half, (0.95, 1.4)),
        across(trim.plastic, (x[0] + 0.05, x[1] - 0.05), half - 0.05, (1.3, 1.402)),
        across(trim.rim, (x[1] - 0.08, x[1]), half, (1.0, 2.2)),
    ]
    cargo = rng.choice(3)
    if cargo == 0:
        wide = (x[1] - x[0]) / 2 - 0.25
        heap = (wide, half - 0.15, float(rng.uniform(0.5, 0.9)))
        solids.append(ball(paint("truck", CARGOES, rng), (sum(x) / 2, 0.0, 1.4), heap))
    elif cargo == 1:
        start = x[0] + 0.2
        while start < x[1] - 1.4:
            long, high = rng.uniform(0.8, 1.3), rng.uniform(0.5, 1.3)
            crate = (start, float(start + long))
            material = paint("truck", CARGOES, rng)
            solids.append(across(material, crate, half - 0.2, (1.4, 1.4 + float(high))))
            start += long + 0.1
    return solids


def _tipper(rng: np.random.Generator, x: tuple[float, float], half: float) -> list[Solid]:
    """A steel tub with ribs, filled with gravel or earth."""
    tub, top = paint("truck", CABS, rng), float(rng.uniform(1.9, 2.3))
    solids = [
        slab(tub, (x[0] + 0.15, x[1]), (x[0] - 0.02, x[1]), half - 0.04, (1.0, top)),
        ball(
            paint("truck", CARGOES, rng),
            (sum(x) / 2, 0.0, top - 0.05),
            ((x[1] - x[0]) / 2 - 0.1, half - 0.12, 0.45),
        ),
        across(tub, x, half, (top - 0.12, top)),
    ]
    for rib in np.linspace(x[0] + 0.5, x[1] - 0.3, 4):
        solids.append(across(tub, (float(rib) - 0.06, float(rib) + 0.06), half, (1.0, top)))
    return solids
