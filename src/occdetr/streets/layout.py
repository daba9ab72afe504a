"""The plan of a street: a curved road, strips beside it, and lots along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Probabilities of the kinds of lots, by style of street.
LOTS = ("house", "garden", "woods", "field", "car park", "square")
STYLES = {
    "urban": (0.85, 0.08, 0.04, 0.00, 0.01, 0.02),
    "suburb": (0.70, 0.17, 0.08, 0.03, 0.01, 0.01),
    "rural": (0.12, 0.17, 0.50, 0.20, 0.00, 0.01),
}


@dataclass(frozen=True)
class Road:
    """A road with the centre line y = polynomial(x); ``lateral`` coordinates grow to the left."""

    coefficients: tuple[float, float, float, float]
    half_width: float
    center_line: bool
    edge_lines: bool

    def center(self, x):
        a, b, c, d = self.coefficients
        return a + x * (b + x * (c + x * d))

    def heading(self, x):
        """Direction of the road at x, radians."""
        _, b, c, d = self.coefficients
        return np.arctan(b + x * (2 * c + x * 3 * d))

    def point(self, along: float, lateral: float) -> tuple[float, float, float]:
        """(x, y, heading) of the point ``lateral`` metres to the left of the centre line."""
        yaw = float(self.heading(along))
        x, y = along - lateral * np.sin(yaw), self.center(along) + lateral * np.cos(yaw)
        return float(x), float(y), yaw

    def foot_of_origin(self) -> tuple[float, float]:
        """(along, lateral) of the point (0, 0)."""
        along = 0.0
        for _ in range(8):  # Newton's method
            yaw = float(self.heading(along))
            along -= (along * np.cos(yaw) + self.center(along) * np.sin(yaw)) * np.cos(yaw)
        yaw = float(self.heading(along))
        return float(along), float(along * np.sin(yaw) - self.center(along) * np.cos(yaw))


@dataclass(frozen=True)
class Crossing:
    """A side road at ``along`` to the left (+1), to the right (-1) or to both sides (0)."""

    along: float
    half_width: float
    skew: float
    side: int


@dataclass(frozen=True)
class Side:
    """Widths in metres of the strips from the road outwards; sign is +1 left, -1 right."""

    sign: int
    parking: float
    verge: float
    sidewalk: float
    parking_height: float

    @property
    def width(self) -> float:
        return self.parking + self.verge + self.sidewalk


@dataclass(frozen=True)
class Lot:
    """An interval [start, end] along one side of the road and what is built there.

    ``driveway`` is a paved strip: start and end along the road, and its depth in metres.
    """

    side: Side
    kind: str
    start: float
    end: float
    setback: float
    paved: bool
    driveway: tuple[float, float, float]


@dataclass(frozen=True)
class Layout:
    """The plan of a street. The ego car starts at ``start`` metres along the road, the origin of
    the world, and drives at ``speed`` m/s at the lateral coordinate ``lane``."""

    road: Road
    crossing: Crossing | None
    sides: tuple[Side, Side]
    lots: tuple[Lot, ...]
    style: str
    start: float
    lane: float
    speed: float

    def edge(self, side: Side) -> float:
        """Lateral distance from the centre line at which the lots of a side begin."""
        return self.road.half_width + side.width


def plan_street(rng: np.random.Generator, length: float) -> Layout:
    """Draw a random plan of a street ``length`` metres long: road, widths, strips and lots."""
    style = str(rng.choice(list(STYLES), p=(0.43, 0.44, 0.13)))
    road = _plan_road(rng)
    crossing = Crossing(
        rng.uniform(9, 42),
        rng.uniform(2.5, 4.5),
        float(np.clip(rng.normal(0, 0.2), -0.5, 0.5)),
        int(rng.integers(-1, 2)),
    )
    sides = (_plan_side(rng, 1, style), _plan_side(rng, -1, style))
    lots = tuple(lot for side in sides for lot in _plan_lots(rng, side, style, length))
    start, lane = road.foot_of_origin()
    speed = rng.uniform(3, 14)
    has_crossing = rng.random() < 0.45
    return Layout(road, crossing if has_crossing else None, sides, lots, style, start, lane, speed)


def _plan_road(rng: np.random.Generator) -> Road:
    half_width = rng.uniform(2.3, 5.2)
    two_way = half_width > 2.8
    lane = half_width * rng.uniform(0.35, 0.6) if two_way else rng.normal(0, 0.4)
    bend = float(np.clip(rng.normal(0, 0.0028), -0.007, 0.007))
    return Road(
        (lane, rng.normal(0, 0.05), bend, float(rng.normal(0, 1.5e-5))),
        half_width,
        center_line=two_way and rng.random() < 0.6,
        edge_lines=rng.random() < 0.3,
    )


def _plan_side(rng: np.random.Generator, sign: int, style: str) -> Side:
    rural = style == "rural"
    parking = rng.uniform(2.0, 2.6) if rng.random() < (0.05 if rural else 0.2) else 0.0
    verge = rng.uniform(0.8, 2.5) if rng.random() < (0.6 if rural else 0.3) else 0.0
    sidewalk = rng.uniform(1.6, 4.2) if rng.random() < (0.35 if rural else 0.95) else 0.0
    return Side(sign, parking, verge, sidewalk, 0.0 if rng.random() < 0.6 else 0.13)


def _plan_lots(rng: np.random.Generator, side: Side, style: str, length: float) -> list[Lot]:
    lots, start = [], -14.0 - rng.uniform(0, 10)
    while start < length:
        end = start + rng.uniform(9, 26)
        kind = str(rng.choice(LOTS, p=STYLES[style]))
        setback = rng.uniform(0, 3) if style == "urban" else rng.uniform(1.5, 7)
        paved = style == "urban" and rng.random() < 0.55
        drive = start + rng.uniform(0.5, 3)
        depth = setback + rng.uniform(0, 8) if kind == "house" and rng.random() < 0.18 else 0.0
        driveway = (drive, drive + rng.uniform(2.6, 5), depth) if depth else (0.0, 0.0, 0.0)
        lots.append(Lot(side, kind, start, end, setback, paved, driveway))
        start = end
    return lots
