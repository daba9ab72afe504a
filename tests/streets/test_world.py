"""The road under the car, and motion."""

import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.geometry.voxels import voxel_centers
from occdetr.streets.ground import SURFACES, surfaces_at
from occdetr.streets.world import World, world_tilt


def test_the_car_is_on_the_road():
    scene = World(seed=0, split=0, index=7).scene
    under = surfaces_at(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), scene.plan)
    assert [SURFACES[surface] for surface in under] == ["road", "road"]
    assert scene.terrain.height(0.0, 0.0) == pytest.approx(-1.73, abs=0.08)


def test_tilted_sensors_see_the_same_world_with_a_tilted_road():
    """A front that is down sees the road rise."""
    level = World(seed=0, split=0, index=2)
    tilted = World(seed=0, split=0, index=2, tilted=True)
    assert (tilted.scene.solids_at(0.0).geometry == level.scene.solids_at(0.0).geometry).all()
    down, left_up = (np.degrees(np.arcsin(x)) for x in (-tilted.tilt[2, 0], tilted.tilt[2, 1]))
    assert (down, left_up) == pytest.approx((0.70, 1.45), abs=0.01)
    slopes = [road_slopes(world.snapshot().voxels().classes) for world in (level, tilted)]
    forward, left = slopes[1] - slopes[0]
    assert forward == pytest.approx(down, abs=0.2)
    assert left == pytest.approx(-left_up, rel=0.25)


def road_slopes(classes):
    """How the plane of road, parking and sidewalks rises forward and to the left, in degrees."""
    paved = [CLASS_NAMES.index(name) for name in ("road", "parking", "sidewalk")]
    points = voxel_centers(np.argwhere(np.isin(classes, paved)))
    points = points[(points[:, 0] < 40) & (abs(points[:, 1]) < 10)]
    ones = np.ones((len(points), 1))
    plane, *_ = np.linalg.lstsq(np.hstack([points[:, :2], ones]), points[:, 2], rcond=None)
    return np.degrees(np.arctan(plane[:2]))


def test_tilts_are_those_of_real_frames():
    tilts = [world_tilt(0, 0, index) for index in range(500)]
    down = np.degrees([np.arcsin(-tilt[2, 0]) for tilt in tilts])
    side = np.degrees([np.arcsin(tilt[2, 1]) for tilt in tilts])
    assert (down.mean(), down.std()) == pytest.approx((0.4, 0.2), abs=0.05)
    assert (side.mean(), side.std()) == pytest.approx((0.9, 0.6), abs=0.1)
    for tilt in tilts[:5]:
        np.testing.assert_allclose(tilt @ tilt.T, np.eye(4), atol=1e-12)


def test_only_moving_objects_move():
    world = World(seed=0, split=0, index=2)
    moving = [thing for thing in world.scene.objects if thing.motion is not None]
    assert moving
    now, later = world.scene.solids_at(0.0), world.scene.solids_at(0.5)
    shift = np.linalg.norm((later.geometry - now.geometry)[:, :2], axis=1)
    still = sum(len(t.forms) for t in world.scene.objects if t.motion is None)
    assert (shift < 1e-9).sum() == still
    cars = now.classes[shift > 0.1]
    movable = ("car", "truck", "other-vehicle", "bicyclist", "motorcyclist", "person")
    assert set(np.unique(cars)) <= {CLASS_NAMES.index(name) for name in movable}
