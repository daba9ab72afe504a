"""The ground of a street: surface class and height at each point, computed from the plan.

``Plan`` holds the plan of a street as arrays for compiled code, and ``surface_at`` is exact at any
point. ``Terrain`` samples it on a fine raster, which the ray tracer traverses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Float, Float32, UInt8

from occdetr.streets.layout import Layout
from occdetr.streets.noise import smooth2

SENSOR_HEIGHT = 1.73  # metres of KITTI's LiDAR above the road
CELL = 0.1  # side of a raster cell in metres
KERB = 0.13
KERB_CELLS = 3  # width of a kerb's slope
#: Surfaces, in the order of the indices that ``surface_at`` returns.
SURFACES = ("road", "sidewalk", "parking", "terrain", "other-ground")
ROAD, SIDEWALK, BAY, GRASS_STRIP, SQUARE = range(5)

#: Surface of each kind of lot; that of houses is random.
LOT_SURFACES = {"car park": BAY, "square": SQUARE}


class Plan(NamedTuple):
    """A ``Layout`` as arrays; where there are two rows, row 0 is the left side, row 1 the right."""

    road: np.ndarray  # polynomial coefficients (4), half width, centre line, edge lines
    crossing: np.ndarray  # along, half width, skew, side; half width 0 if there is none
    strips: np.ndarray  # (2, 4): widths of parking, verge, sidewalk; height of the parking strip
    lot_starts: np.ndarray  # (2, most lots), metres along, inf after the last lot
    lots: np.ndarray  # (2, most lots, 4): surface, driveway's start and end, its depth
    relief: np.ndarray  # curvature along, slope across, two banks, roughness, seed; start


@dataclass(frozen=True)
class Terrain:
    """Heights (metres) and surfaces on a raster whose cell (0, 0) has its centre at ``origin``."""

    origin: tuple[float, float]
    heights: Float32[np.ndarray, "x y"]
    surfaces: UInt8[np.ndarray, "x y"]

    def height(self, x: float, y: float) -> float:
        """Height at a point; outside the raster, that of its border."""
        return float(self.heights[self._cell(x, y)])

    def surface(self, x: float, y: float) -> str:
        return SURFACES[self.surfaces[self._cell(x, y)]]

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        i = round((x - self.origin[0]) / CELL)
        j = round((y - self.origin[1]) / CELL)
        width, depth = self.heights.shape
        return min(max(i, 0), width - 1), min(max(j, 0), depth - 1)


def make_plan(layout: Layout, rng: np.random.Generator) -> Plan:
    """The layout as arrays, with a random relief."""
    road, crossing = layout.road, layout.crossing
    most = max(sum(lot.side is side for lot in layout.lots) for side in layout.sides)
    starts, lots = np.full((2, most), np.inf), np.zeros((2, most, 4))
    for row, side in enumerate(layout.sides):
        own = [lot for lot in layout.lots if lot.side is side]
        for column, lot in enumerate(own):
            starts[row, column] = lot.start
            paved = lot.kind == "house" and lot.paved
            surface = SIDEWALK if paved else LOT_SURFACES.get(lot.kind, GRASS_STRIP)
            lots[row, column] = surface, *lot.driveway
    return Plan(
        road=np.array(
            [*road.coefficients, road.half_width, float(road.center_line), float(road.edge_lines)]
        ),
        crossing=np.array(
            [crossing.along, crossing.half_width, crossing.skew, float(crossing.side)]
            if crossing
            else [0.0, 0.0, 0.0, 0.0]
        ),
        strips=np.array([[s.parking, s.verge, s.sidewalk, s.parking_height] for s in layout.sides]),
        lot_starts=starts,
        lots=lots,
        relief=np.array(
            [
                rng.normal(0, 1.2e-4),
                rng.normal(0, 0.008),
                *rng.normal(0.02, 0.06, 2),
                rng.uniform(0.05, 0.3),
                float(rng.integers(1, 1 << 16)),
                layout.start,
                layout.lane,
            ]
        ),
    )


def make_terrain(
    plan: Plan, x_limits: tuple[float, float], y_limits: tuple[float, float]
) -> Terrain:
    """Sample a plan within limits in metres."""
    x = np.arange(x_limits[0], x_limits[1], CELL)
    y = np.arange(y_limits[0], y_limits[1], CELL)
    heights = np.empty((len(x), len(y)), dtype=np.float32)
    surfaces = np.empty((len(x), len(y)), dtype=np.uint8)
    raised = np.empty_like(heights)
    _sample(x, y, plan, heights, raised, surfaces)
    heights += cv2.blur(
        raised, (KERB_CELLS, KERB_CELLS)
    )  # a raster cannot represent a vertical step
    return Terrain((x_limits[0], y_limits[0]), heights, surfaces)


def road_height(plan: Plan, along: float, lateral: float) -> float:
    """Height of the road's surface (metres, world frame)."""
    return float(_relief(along, lateral, plan)) - SENSOR_HEIGHT


def surfaces_at(points: Float[np.ndarray, "point 3"], plan: Plan) -> UInt8[np.ndarray, " point"]:
    """The surface (an index into ``SURFACES``) at points of the ground."""
    surfaces = np.empty(len(points), dtype=np.uint8)
    _find_surfaces(points, plan, surfaces)
    return surfaces


@numba.njit(cache=True, nogil=True)
@no_type_check
def locate(x, y, road):
    """(along, lateral) of a point, by its perpendicular to the road's centre line."""
    a, b, c, d = road[0], road[1], road[2], road[3]
    along = x
    lateral = 0.0
    for _ in range(2):
        slope = b + along * (2 * c + along * 3 * d)
        length = math.sqrt(1.0 + slope * slope)
        cos, sin = 1.0 / length, slope / length
        dx, dy = x - along, y - (a + along * (b + along * (c + along * d)))
        lateral = dy * cos - dx * sin
        along += (dx * cos + dy * sin) * cos
    return along, lateral


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def surface_at(along, lateral, plan):
    """(surface, metres above the road's level) at road coordinates."""
    half_width, row = plan.road[4], (0 if lateral >= 0 else 1)
    edge = abs(lateral) - half_width
    if edge < 0.0:
        return ROAD, 0.0
    crossing = plan.crossing
    if crossing[1] > 0.0 and lateral * crossing[3] >= 0.0:
        distance = abs(along - crossing[0] - crossing[2] * lateral)
        if distance < crossing[1] + 2.5 * max(0.0, 1.0 - edge / 2.5) ** 2:  # rounded corners
            return ROAD, 0.0
        if distance < crossing[1] + 2.2:
            return SIDEWALK, KERB
    strips, lots = plan.strips, plan.lots
    parking, verge, sidewalk = strips[row, 0], strips[row, 1], strips[row, 2]
    if edge < parking:
        return BAY, strips[row, 3]
    edge -= parking
    lot = 0
    while lot + 1 < lots.shape[1] and plan.lot_starts[row, lot + 1] < along:
        lot += 1
    drive = lots[row, lot, 1] < along < lots[row, lot, 2]
    driveway = drive and edge < verge + sidewalk + lots[row, lot, 3]
    if edge < verge:
        return (BAY, 0.5 * KERB) if driveway else (GRASS_STRIP, KERB)
    if edge < verge + sidewalk:
        return SIDEWALK, KERB
    if driveway:
        return BAY, KERB
    surface = int(lots[row, lot, 0])
    return surface, (0.0 if surface == BAY and sidewalk == 0.0 else KERB)


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _relief(along, lateral, plan):
    """Height of the terrain in metres, without kerbs."""
    relief = plan.relief
    row = 0 if lateral >= 0 else 1
    outside = abs(lateral) - plan.road[4] - plan.strips[row, 0] - plan.strips[row, 2]
    beyond = min(max(outside - 3.0, 0.0), 14.0)
    crossing = plan.crossing
    if crossing[1] > 0.0 and lateral * crossing[3] >= 0.0:  # a side road is level
        distance = abs(along - crossing[0] - crossing[2] * lateral) - crossing[1] - 2.0
        beyond *= min(max(distance / 8.0, 0.0), 1.0)
    ahead = along - relief[6]  # measured from the car's start, which is the world's origin
    height = relief[0] * ahead * ahead + relief[1] * (min(max(lateral, -12.0), 12.0) - relief[7])
    height += beyond * relief[2 + row]
    if beyond == 0.0:
        return height
    rolling = smooth2(along, lateral, 9.0, int(relief[5])) + 0.4 * smooth2(along, lateral, 2.5, 5)
    return height + relief[4] * min(beyond / 3.0, 1.0) * rolling


@numba.njit(cache=True, nogil=True)
@no_type_check
def _sample(xs, ys, plan, heights, raised, surfaces):
    for i in range(len(xs)):
        for j in range(len(ys)):
            along, lateral = locate(xs[i], ys[j], plan.road)
            surfaces[i, j], raised[i, j] = surface_at(along, lateral, plan)
            heights[i, j] = _relief(along, lateral, plan) - SENSOR_HEIGHT


@numba.njit(cache=True, nogil=True)
@no_type_check
def _find_surfaces(points, plan, surfaces):
    for i in range(len(points)):
        along, lateral = locate(points[i, 0], points[i, 1], plan.road)
        surfaces[i], _ = surface_at(along, lateral, plan)
