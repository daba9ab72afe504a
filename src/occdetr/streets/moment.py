"""A world through which a car drives, and what its camera and its scanner take at each scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from occdetr.geometry.camera import scale_projection
from occdetr.geometry.kitti import Calibration
from occdetr.streets.drive import ego_pose, sweep_places
from occdetr.streets.ground import SURFACES
from occdetr.streets.populate import make_street
from occdetr.streets.render import View, draw_light, render, see
from occdetr.streets.scan import Scan, scan_street
from occdetr.streets.trace import Index, build_index
from occdetr.streets.voxelize import Voxels, voxelize

SCAN_SECONDS = 0.1
KITTI_IMAGE_SIZE = (370, 1226)

# P2 and Tr of KITTI odometry's sequences 04-10.
_PROJECTION = (
    (707.0912, 0.0, 601.8873, 46.88783),
    (0.0, 707.0912, 183.1104, 0.1178601),
    (0.0, 0.0, 1.0, 0.006203223),
)
_LIDAR_TO_CAMERA = (
    (-0.001857739385241, -0.9999659513510, -0.008039975204516, -0.004784029760483),
    (-0.006481465826011, 0.008051860151134, -0.9999466081774, -0.07337429464231),
    (0.9999773098287, -0.001805528627661, -0.006496203536139, -0.3339968064433),
    (0.0, 0.0, 0.0, 1.0),
)


@dataclass(frozen=True)
class Camera:
    """The camera that takes the pictures: their size (height, width), and the horizontal field of
    view in degrees; ``None`` is KITTI's camera, its intrinsics scaled to the size."""

    image_size: tuple[int, int] = KITTI_IMAGE_SIZE
    horizontal_fov: float | None = None

    @property
    def calibration(self) -> Calibration:
        height, width = self.image_size
        if self.horizontal_fov is None:
            scale_x, scale_y = width / KITTI_IMAGE_SIZE[1], height / KITTI_IMAGE_SIZE[0]
            projection = scale_projection(np.array(_PROJECTION), scale_x, scale_y)
        else:
            focal = 0.5 * width / math.tan(math.radians(self.horizontal_fov) / 2)
            projection = np.zeros((3, 4))
            projection[0, 0] = projection[1, 1] = focal
            projection[:2, 2] = (width - 1) / 2, (height - 1) / 2
            projection[2, 2] = 1.0
        return Calibration(projection, np.array(_LIDAR_TO_CAMERA))


class World:
    """World number ``index`` of a split (0 train, 1 val), drawn from its three numbers alone.

    It does not depend on the camera, nor on the number of scans that are taken of it.
    """

    def __init__(self, seed: int, split: int, index: int) -> None:
        self._key = (seed, split, index)
        self.scene = make_street(self.random(0))
        self.light = draw_light(self.random(1))

    def random(self, *part: int) -> np.random.Generator:
        """The random numbers of one part of this world."""
        return np.random.default_rng([*self._key, *part])

    def moment(self, scan: int = 0) -> Moment:
        """The world at scan number ``scan``, at 10 Hz."""
        return Moment(self, scan)


class Moment:
    """A world while one scan is taken."""

    def __init__(self, world: World, scan: int) -> None:
        self.world, self.scan = world, scan
        scene, time = world.scene, scan * SCAN_SECONDS
        self.along = scene.layout.speed * time
        self.pose: Float[np.ndarray, "4 4"] = ego_pose(scene.layout, scene.plan, self.along)
        self.solids = scene.solids_at(time)

    @cached_property
    def index(self) -> Index:
        return build_index(self.solids, self.world.scene.terrain)

    def view(self, camera: Camera) -> View:
        """What each pixel of the camera sees."""
        calibration = camera.calibration
        projections = calibration.projection, calibration.lidar_to_camera
        return see(self.index, self.pose, *projections, camera.image_size)

    def picture(self, view: View) -> UInt8[np.ndarray, "height width 3"]:
        """The RGB picture of a view."""
        world = self.world
        rng = world.random(2, self.scan)
        return render(world.scene, self.solids, self.index, view, world.light, rng)

    def voxels(self) -> Voxels:
        """The voxels that surfaces run through, in the grid of the car."""
        scene = self.world.scene
        ground = scene.palette.classes[: len(SURFACES)]
        return voxelize(self.solids, scene.terrain, ground, np.linalg.inv(self.pose))

    def sweep(self, voxels: Voxels) -> Scan:
        """The voxel files, from sweeps here and along the way ahead."""
        scene = self.world.scene
        places = sweep_places(scene.layout, scene.plan, self.along, self.pose)
        return scan_street(voxels, places, self.world.random(3, self.scan))
