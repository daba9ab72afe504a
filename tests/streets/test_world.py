"""The road under the car, and motion."""

import numpy as np
import pytest

from occdetr.classes import CLASS_NAMES
from occdetr.streets.ground import SURFACES, surfaces_at
from occdetr.streets.world import World


def test_the_car_is_on_the_road():
    scene = World(seed=0, split=0, index=7).scene
    under = surfaces_at(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), scene.plan)
    assert [SURFACES[surface] for surface in under] == ["road", "road"]
    assert scene.terrain.height(0.0, 0.0) == pytest.approx(-1.73, abs=0.08)


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
