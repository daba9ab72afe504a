"""The plan of a street: a curved road, strips beside it, and lots along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Odds of what stands on a lot, per style of street.
LOTS = ("house", "garden", "woods", "field", "car park", "square")
STYLES = {
    "urban": (0.70, 0.10, 0.03, 0.00, 0.08, 0.09),
    "suburb": (0.50, 0.24, 0.10, 0.06, 0.05, 0.05),
    "rural": (0.08, 0.17, 0.40, 0.30, 0.02, 0.03),
}


@dataclass(frozen=True)
class Road:
    """A road whose middle runs along y = polynomial(x); ``lateral`` coordinates count leftwards."""

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
        """(x, y, heading) of the place ``lateral`` metres left of the middle."""
        yaw = float(self.heading(along))
        x, y = along - lateral * np.sin(yaw), self.center(along) + lateral * np.cos(yaw)
        return float(x), float(y), yaw

    def locate(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(along, lateral) of positions; exact where the road is straight."""
        yaw = self.heading(x)
        lateral = (y - self.center(x)) * np.cos(yaw)
        return x + lateral * np.sin(yaw), lateral


@dataclass(frozen=True)
class Crossing:
    """A side road that leaves at ``along`` to the left (+1), right (-1) or both (0) sides."""

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

    @property
    def width(self) -> float:
        return self.parking + self.verge + self.sidewalk


@dataclass(frozen=True)
class Lot:
    """A stretch [start, end] along one side of the road and what it holds."""

    side: Side
    kind: str
    start: float
    end: float
    setback: float


@dataclass(frozen=True)
class Layout:
    """The plan of a street; ``lane`` is the ego car's lateral coordinate."""

    road: Road
    crossing: Crossing | None
    sides: tuple[Side, Side]
    lots: tuple[Lot, ...]
    style: str
    lane: float


def plan_street(rng: np.random.Generator) -> Layout:
    """Draw a plan; every world differs in road, widths, strips and lots."""
    style = str(rng.choice(list(STYLES), p=(0.38, 0.44, 0.18)))
    road = _plan_road(rng)
    side = int(rng.integers(-1, 2))
    crossing = Crossing(rng.uniform(9, 42), rng.uniform(2.5, 4.5), float(rng.normal(0, 0.2)), side)
    sides = (_plan_side(rng, 1, style), _plan_side(rng, -1, style))
    lots = tuple(lot for side in sides for lot in _plan_lots(rng, side, style))
    lane = -road.center(0.0) * float(np.cos(road.heading(0.0)))
    return Layout(road, crossing if rng.random() < 0.4 else None, sides, lots, style, lane)


def _plan_road(rng: np.random.Generator) -> Road:
    half_width = rng.uniform(2.3, 5.6)
    two_way = half_width > 2.8
    lane = half_width * rng.uniform(0.35, 0.6) if two_way else rng.normal(0, 0.5)
    bend = float(np.clip(rng.normal(0, 0.0028), -0.007, 0.007))
    return Road(
        (lane, rng.normal(0, 0.06), bend, float(rng.normal(0, 1.5e-5))),
        half_width,
        center_line=two_way and rng.random() < 0.7,
        edge_lines=rng.random() < 0.4,
    )


def _plan_side(rng: np.random.Generator, sign: int, style: str) -> Side:
    rural = style == "rural"
    parking = rng.uniform(2.0, 2.8) if rng.random() < (0.1 if rural else 0.45) else 0.0
    verge = rng.uniform(0.8, 3.0) if rng.random() < (0.6 if rural else 0.35) else 0.0
    sidewalk = rng.uniform(1.4, 4.0) if rng.random() < (0.3 if rural else 0.9) else 0.0
    return Side(sign, parking, verge, sidewalk)


def _plan_lots(rng: np.random.Generator, side: Side, style: str) -> list[Lot]:
    lots, start = [], -12.0 - rng.uniform(0, 10)
    while start < 95:
        end = start + rng.uniform(9, 26)
        kind = str(rng.choice(LOTS, p=STYLES[style]))
        setback = rng.uniform(0, 2.5) if style == "urban" else rng.uniform(1.5, 8)
        lots.append(Lot(side, kind, start, end, setback))
        start = end
    return lots
