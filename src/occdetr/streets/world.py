"""A world through which a car drives, and what its camera and its scanner record at each scan."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from occdetr.geometry.camera import Camera
from occdetr.streets.drive import draw_tilt, ego_pose, sweep_places
from occdetr.streets.ground import SURFACES
from occdetr.streets.light import draw_light
from occdetr.streets.populate import make_street
from occdetr.streets.render import View, render, trace_view
from occdetr.streets.scan import Scan, scan_street
from occdetr.streets.trace import Index, build_index
from occdetr.streets.voxelize import Voxels, voxelize

SCAN_SECONDS = 0.1


def world_tilt(seed: int, split: int, index: int) -> Float[np.ndarray, "4 4"]:
    """The tilt of the sensors in a world, see ``drive.draw_tilt``."""
    return draw_tilt(np.random.default_rng([seed, split, index, 4]))


class World:
    """World number ``index`` of a split (0 train, 1 val), generated from these three numbers alone.

    It depends neither on the camera nor on the number of scans. With ``tilted`` the car's sensors
    are tilted against the road (``drive.draw_tilt``), which changes nothing else.
    """

    def __init__(self, seed: int, split: int, index: int, tilted: bool = False) -> None:
        self._key = (seed, split, index)
        self.tilt = world_tilt(seed, split, index) if tilted else np.eye(4)
        self.scene = make_street(self.random(0))
        self.light = draw_light(self.random(1))

    def random(self, *part: int) -> np.random.Generator:
        """The random number generator of one part of this world."""
        return np.random.default_rng([*self._key, *part])

    def snapshot(self, scan: int = 0) -> Snapshot:
        """The world at scan number ``scan``; scans are taken at 10 Hz."""
        return Snapshot(self, scan)


class Snapshot:
    """A world at the time of one scan; ``pose`` maps the LiDAR frame to the world frame."""

    def __init__(self, world: World, scan: int) -> None:
        self.world, self.scan = world, scan
        scene, time = world.scene, scan * SCAN_SECONDS
        self.along = scene.layout.speed * time
        level = ego_pose(scene.layout, scene.plan, self.along)
        self.pose: Float[np.ndarray, "4 4"] = level @ world.tilt
        self.solids = scene.solids_at(time)

    @cached_property
    def index(self) -> Index:
        """The spatial index for ray tracing."""
        return build_index(self.solids, self.world.scene.terrain)

    def view(self, camera: Camera) -> View:
        """What each pixel of the camera sees."""
        return trace_view(self.index, self.pose, camera)

    def picture(self, view: View) -> UInt8[np.ndarray, "height width 3"]:
        """The RGB image of a view."""
        world = self.world
        rng = world.random(2, self.scan)
        return render(world.scene, self.solids, self.index, view, world.light, rng)

    def voxels(self) -> Voxels:
        """The voxels that contain surfaces, in the car's grid."""
        scene = self.world.scene
        ground = scene.palette.classes[: len(SURFACES)]
        return voxelize(self.solids, scene.terrain, ground, np.linalg.inv(self.pose))

    def sweep(self, voxels: Voxels) -> Scan:
        """The voxel labels and masks, from sweeps at this place and along the way ahead."""
        scene = self.world.scene
        places = sweep_places(scene.layout, scene.plan, self.along, self.pose)
        return scan_street(voxels, places, self.world.random(3, self.scan))
