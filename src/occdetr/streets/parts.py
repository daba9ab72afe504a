"""Colours and parts that vehicles, people and street furniture have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from occdetr.streets.solids import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    GLASS,
    METAL,
    PLAIN,
    WHEEL,
    Color,
    Material,
    Solid,
    box,
)

#: x, y, z in metres, in the object's frame.
Point = tuple[float, float, float]
Range = tuple[float, float]

TYRE = (0.05, 0.05, 0.055)
PLASTIC = (0.09, 0.09, 0.10)
WHITE_LIGHT = (0.92, 0.93, 0.90)
RED_LIGHT = (0.70, 0.04, 0.04)
NUMBER_PLATE = (0.90, 0.89, 0.82)


class Trim(NamedTuple):
    """The materials of a vehicle besides its paint."""

    glass: Material
    tyre: Material
    rim: Material
    plastic: Material
    white_light: Material
    red_light: Material
    plate: Material


def make_trim(class_name: str, rng: np.random.Generator) -> Trim:
    """Glass, tyres, lights and so on of a class; the grey of the rims is random."""
    rim = float(rng.uniform(0.35, 0.68))
    return Trim(
        Material(class_name, (0.05, 0.065, 0.08), GLASS),
        Material(class_name, TYRE),
        Material(class_name, (rim, rim, rim + 0.02), METAL),
        Material(class_name, PLASTIC),
        Material(class_name, WHITE_LIGHT),
        Material(class_name, RED_LIGHT),
        Material(class_name, NUMBER_PLATE),
    )


def pick(colors: Sequence[Color], rng: np.random.Generator) -> Color:
    """One of the colours with a random change of brightness."""
    chosen = np.array(colors[int(rng.integers(len(colors)))]) * rng.uniform(0.85, 1.1)
    red, green, blue = np.clip(chosen, 0.0, 1.0).tolist()
    return red, green, blue


def paint(
    class_name: str, colors: Sequence[Color], rng: np.random.Generator, texture: int = PLAIN
) -> Material:
    """A material of the class in one of the colours."""
    return Material(class_name, pick(colors, rng), texture)


def slab(
    material: Material,
    bottom: Range,
    top: Range,
    half_y: float,
    z: Range,
    taper_y: float = 1.0,
    y: float = 0.0,
) -> Solid:
    """A box with other x limits at the bottom than at the top, so its ends may be sloped."""
    middle, half = sum(bottom) / 2, (bottom[1] - bottom[0]) / 2
    taper = (top[1] - top[0]) / (bottom[1] - bottom[0])
    shift = (sum(top) / 2 - middle) / half
    center, halves = (middle, y, sum(z) / 2), (half, half_y, (z[1] - z[0]) / 2)
    return Solid(material, center, halves, BOX, taper=(taper, taper_y), shift=shift)


def across(material: Material, x: Range, half_y: float, z: Range) -> Solid:
    """A box over the whole width, visible on both sides."""
    return box(material, x, (-half_y, half_y), z)


def beam(
    material: Material, start: Point, end: Point, radius: float, end_radius: float | None = None
) -> Solid:
    """A square bar between two points with horizontal ends: limbs, tubes, arms."""
    radii = (radius, radius if end_radius is None else end_radius)
    (low, thick), (high, thin) = sorted(
        zip((start, end), radii, strict=True), key=lambda tip: tip[0][2]
    )
    run = math.hypot(high[0] - low[0], high[1] - low[1])
    rise = high[2] - low[2]
    yaw = math.atan2(high[1] - low[1], high[0] - low[0])
    z, half_z = (low[2] + high[2]) / 2, rise / 2
    if rise < radius:  # horizontal
        center = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, z)
        return Solid(material, center, (run / 2, thick, thick), BOX, yaw)
    steep = rise / math.hypot(run, rise)
    half = thick / max(steep, 0.5)
    if steep < 0.5:  # a flat bar keeps its vertical thickness; its ends are wedges
        half_z += thick
        moved = run / (1 + thick / half_z)
        half = (run - moved) / 2
        start_x = half
        run = moved
    else:
        start_x = 0.0
    center = (low[0] + start_x * math.cos(yaw), low[1] + start_x * math.sin(yaw), z)
    taper = (thin / thick, thin / thick)
    return Solid(material, center, (half, thick, half_z), BOX, yaw, taper, run / half)


def tube(
    material: Material, x: float, y: float, z: Range, radius: float, top: float = 1.0
) -> Solid:
    """An upright cylinder; its top is ``top`` times as wide."""
    half = (radius, radius, (z[1] - z[0]) / 2)
    return Solid(material, (x, y, sum(z) / 2), half, CYLINDER, taper=(top, top))


def ball(material: Material, center: Point, half: Point, yaw: float = 0.0) -> Solid:
    """An ellipsoid."""
    return Solid(material, center, half, ELLIPSOID, yaw)


def wheel(
    material: Material, center: Point, radius: float, half_width: float, hole: float = 0.0
) -> Solid:
    """A wheel, or a ring if ``hole`` (the share of its radius) is not 0."""
    return Solid(material, center, (radius, half_width, radius), WHEEL, taper=(hole, 1.0))


def axles(
    trim: Trim, at: Sequence[float], width: float, radius: float, tyre: float = 0.2
) -> list[Solid]:
    """Two tyres for each axle, and one rim that is visible on both sides."""
    solids = []
    for x in at:
        for side in (-1, 1):
            center = (x, side * ((width - tyre) / 2 + 0.006), radius)
            solids.append(wheel(trim.tyre, center, radius, tyre / 2))
        solids.append(wheel(trim.rim, (x, 0.0, radius), 0.62 * radius, width / 2 + 0.012))
    return solids


def lamps(
    trim: Trim, cover: Material, x: float, half_y: float, z: Range, inner: float, wrap: float
) -> list[Solid]:
    """A pair of lights at the vehicle's end x, red at the rear: a band with a covered middle.

    ``inner`` is the half width of the cover, ``wrap`` the length of the lights on the sides.
    """
    sign = 1.0 if x > 0 else -1.0
    band, lid = (sorted((x + sign * out, x - sign * wrap)) for out in (0.01, 0.016))
    light = trim.white_light if x > 0 else trim.red_light
    return [
        across(light, (band[0], band[1]), half_y + 0.004, z),
        across(cover, (lid[0], lid[1]), inner, (z[0] - 0.01, z[1] + 0.01)),
    ]
