"""SemanticKITTI's other vehicles: buses, caravans, trailers and tractors."""

from __future__ import annotations

import numpy as np

from occdetr.streets.parts import across, axles, lamps, make_trim, paint, slab, tube, wheel
from occdetr.streets.solids import METAL, PAINT, Material, Shape, box

BUSES = (
    (0.85, 0.66, 0.08),
    (0.72, 0.10, 0.09),
    (0.14, 0.42, 0.64),
    (0.28, 0.52, 0.24),
    (0.87, 0.87, 0.85),
)
CARAVANS = ((0.88, 0.87, 0.82), (0.84, 0.82, 0.74))
TARPAULINS = ((0.25, 0.30, 0.42), (0.30, 0.42, 0.30), (0.55, 0.55, 0.55), (0.55, 0.16, 0.14))
TRACTORS = ((0.10, 0.38, 0.14), (0.62, 0.10, 0.08), (0.12, 0.28, 0.58))


def other_vehicle(rng: np.random.Generator) -> Shape:
    """A bus, a caravan, a small trailer or a tractor."""
    kinds = (_bus, _caravan, _trailer, _tractor)
    return kinds[rng.choice(4, p=(0.5, 0.2, 0.15, 0.15))](rng)


def _bus(rng: np.random.Generator) -> Shape:
    """A city bus: a band of windows, doors on the right, a display above the windscreen."""
    name = "other-vehicle"
    length, width = float(rng.uniform(8.6, 12.0)), float(rng.uniform(2.35, 2.55))
    height = float(rng.uniform(2.85, 3.1))
    end, half, trim = length / 2, width / 2, make_trim(name, rng)
    body = paint(name, BUSES, rng, PAINT)
    roof, amber = paint(name, (body.color, BUSES[-1]), rng), Material(name, (0.95, 0.60, 0.10))
    axle = (-end + 0.26 * length, end - 0.23 * length)
    solids = [
        across(trim.plastic, (-end + 0.05, end - 0.05), half - 0.02, (0.28, 0.45)),
        across(body, (-end, end), half, (0.35, 1.1)),
        across(trim.glass, (-end + 0.01, end - 0.01), half - 0.012, (1.1, 2.2)),
        slab(roof, (-end, end), (-end + 0.1, end - 0.15), half, (2.2, height), 0.94),
        slab(roof, (-end + 1.5, end - 3.0), (-end + 1.7, end - 3.3), 0.8, (height, height + 0.22)),
        across(roof, (-end, -end + 0.7), half - 0.005, (1.0, 2.2)),
        across(trim.glass, (-end - 0.01, -end + 0.2), half - 0.25, (1.35, 2.25)),
        across(roof, (end - 0.16, end), half - 0.005, (1.0, 2.2)),
        across(trim.glass, (end - 0.3, end + 0.012), half - 0.1, (0.95, 2.36)),
        across(trim.plastic, (end - 0.3, end), 0.75, (2.36, 2.75)),
        across(amber, (end - 0.3, end + 0.006), 0.5, (2.47, 2.64)),
        *axles(trim, axle, width, 0.48, 0.28),
        *lamps(trim, body, end, half - 0.02, (0.55, 0.72), 0.6 * half, 0.2),
        *lamps(trim, body, -end, half - 0.02, (0.75, 1.25), 0.82 * half, 0.06),
        across(trim.plastic, (end - 0.2, end - 0.08), half + 0.2, (1.85, 2.2)),
        across(trim.plate, (-end - 0.015, end + 0.02), 0.26, (0.42, 0.53)),
    ]
    for x in axle:
        arch = ((x - 0.6, x + 0.6), (x - 0.4, x + 0.4))
        solids.append(slab(trim.plastic, *arch, half + 0.004, (0.3, 1.08)))
    for x in np.linspace(-end + 2.0, end - 1.7, 4).tolist():
        solids.append(across(trim.plastic, (x - 0.06, x + 0.06), half - 0.004, (1.1, 2.2)))
    for x in (end - 1.0, 0.1):
        side = (-half - 0.012, -half + 0.1)
        solids.append(box(trim.glass, (x - 0.6, x + 0.6), side, (0.42, 2.25)))
    return Shape((length + 0.05, width + 0.05), solids)


def _caravan(rng: np.random.Generator) -> Shape:
    """A caravan: windows at its sides and front, a stripe, one axle, a drawbar."""
    name = "other-vehicle"
    length, width = float(rng.uniform(4.8, 6.4)), float(rng.uniform(2.1, 2.4))
    height, half, trim = float(rng.uniform(2.35, 2.6)), width / 2, make_trim(name, rng)
    body, stripe = paint(name, CARAVANS, rng, PAINT), paint(name, BUSES, rng)
    rear, front = -length / 2, length / 2 - 1.1
    middle, roof = (rear + front) / 2, (rear + 0.2, front - 0.5)
    return Shape(
        (length + 0.1, width + 0.05),
        [
            slab(body, (rear, front), (rear + 0.05, front + 0.1), half, (0.42, 1.3)),
            slab(body, (rear + 0.05, front + 0.1), roof, half, (1.3, height), 0.97),
            slab(
                trim.glass,
                (front - 0.3, front + 0.06),
                (front - 0.6, front - 0.24),
                0.7 * half,
                (1.4, 2.0),
            ),
            across(trim.glass, (rear + 0.1, rear + 0.4), 0.55 * half, (1.4, 1.95)),
            across(trim.glass, (middle - 0.1, middle + 1.0), half + 0.005, (1.35, 1.9)),
            across(trim.glass, (rear + 0.5, rear + 1.2), half + 0.005, (1.35, 1.9)),
            across(stripe, (rear + 0.03, front), half + 0.006, (0.95, 1.1)),
            box(trim.rim, (middle - 0.95, middle - 0.3), (-half - 0.01, -half + 0.1), (0.5, 2.15)),
            *axles(trim, (middle,), width - 0.02, 0.32, 0.2),
            slab(
                trim.plastic,
                (middle - 0.45, middle + 0.45),
                (middle - 0.3, middle + 0.3),
                half + 0.004,
                (0.4, 0.72),
            ),
            *lamps(trim, trim.plastic, rear, half - 0.05, (0.55, 0.75), 0.55 * half, 0.05),
            across(trim.plate, (rear - 0.02, rear + 0.1), 0.26, (0.6, 0.71)),
            slab(trim.plastic, (front, front + 1.1), (front, front + 1.05), 0.06, (0.4, 0.5)),
            tube(trim.rim, front + 0.85, 0.0, (0.0, 0.75), 0.04),
        ],
    )


def _trailer(rng: np.random.Generator) -> Shape:
    """A car's trailer with a tarpaulin over its frame, or open."""
    name = "other-vehicle"
    length, width = float(rng.uniform(3.2, 4.4)), float(rng.uniform(1.5, 1.9))
    half, trim = width / 2, make_trim(name, rng)
    sheet, tarpaulin = Material(name, (0.55, 0.56, 0.58), METAL), paint(name, TARPAULINS, rng)
    rear, front = -length / 2, length / 2 - 1.1
    middle, top = (rear + front) / 2, float(rng.choice((1.15, 1.7, 2.1)))
    solids = [
        across(sheet, (rear, front), half - 0.2, (0.5, 0.95)),
        slab(
            tarpaulin, (rear - 0.01, front + 0.01), (rear + 0.05, front - 0.15), half - 0.19,
            (0.85, top), 0.95,
        ),
        *axles(trim, (middle,), width, 0.3, 0.18),
        across(trim.plastic, (middle - 0.4, middle + 0.4), half, (0.6, 0.66)),
        *lamps(trim, trim.plastic, rear, half - 0.1, (0.42, 0.56), 0.5 * half, 0.05),
        across(trim.plate, (rear - 0.02, rear + 0.1), 0.26, (0.43, 0.54)),
        across(trim.plastic, (front, front + 1.1), 0.05, (0.42, 0.5)),
        tube(trim.rim, front + 0.8, 0.0, (0.0, 0.7), 0.04),
    ]  # fmt: skip
    return Shape((length + 0.1, width + 0.05), solids)


def _tractor(rng: np.random.Generator) -> Shape:
    """A farm tractor: large wheels at the back, small ones in front, a glazed cab."""
    name, trim = "other-vehicle", make_trim("other-vehicle", rng)
    body, rims = paint(name, TRACTORS, rng, PAINT), Material(name, (0.80, 0.72, 0.20))
    big, width = float(rng.uniform(0.72, 0.88)), float(rng.uniform(1.9, 2.2))
    half, rear, front = width / 2, -1.0, 1.25
    yellow = trim._replace(rim=rims)
    solids = [
        *axles(yellow, (rear,), width, big, 0.45),
        *axles(yellow, (front,), width - 0.25, 0.6 * big, 0.32),
        across(trim.plastic, (rear, front), 0.28, (0.55, 0.95)),
        across(trim.plastic, (rear - 0.66 * big, rear), half - 0.46, (0.3, 1.3)),
        across(trim.plastic, (front, front + 0.4 * big), half - 0.45, (0.2, 0.9)),
        slab(body, (-0.3, 1.85), (-0.3, 1.72), 0.36, (0.9, 1.6), 0.85),
        across(trim.plastic, (1.6, 1.86), 0.26, (0.95, 1.45)),
        *lamps(trim, trim.plastic, 1.83, 0.34, (1.3, 1.45), 0.14, 0.1),
        slab(trim.glass, (-1.45, 0.0), (-1.35, -0.15), 0.72, (1.1, 2.5), 0.92),
        slab(body, (-1.55, 0.1), (-1.4, -0.15), 0.74, (2.5, 2.68), 0.9),
        slab(body, (-0.78, -0.7), (-0.8, -0.72), 0.73, (1.1, 2.5), 0.92),
        slab(body, (rear - big, rear + big), (rear - 0.4, rear + 0.4), half - 0.02, (1.3, 1.8)),
        tube(trim.rim, 0.55, 0.28, (1.5, 2.5), 0.05),
        across(trim.red_light, (rear - big - 0.02, rear - big + 0.1), half - 0.1, (1.3, 1.42)),
        wheel(rims, (rear, 0.0, big), 0.2, half + 0.03),
    ]
    return Shape((2 * max(1.9, big - rear) + 0.1, width + 0.1), solids)
