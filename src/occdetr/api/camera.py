"""A camera of one's own: its lens, and how it is mounted."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from occdetr.api.lens_files import LensFile, read_lens_file
from occdetr.data.images import MAX_OFF_CENTER
from occdetr.errors import InputError, Range, check_range
from occdetr.geometry import camera as pinhole
from occdetr.geometry.kitti import KITTI_CAMERA_HEIGHT, kitti_camera, read_calibration

FIELD_OF_VIEW = Range(5, 170)  # degrees
HEIGHT = Range(0.2, 10)  # metres
ANGLE = Range(-180, 180)  # degrees
LIDAR_HEIGHT = 1.73  # metres of the grid frame's origin above the ground, as KITTI's LiDAR
MOST_OFF_AXIS = math.radians(85)  # of rays that a lens without fish-eye model shows
#: Largest relative difference of an image's aspect from the calibration's: of rounded sizes.
SAME_ASPECT = 0.001


@dataclass(frozen=True)
class Mount:
    """How a camera stands on the vehicle.

    ``height``: metres above the ground. ``pitch``: degrees upwards. ``roll``: degrees clockwise, as
    the camera itself sees it. ``yaw``: degrees to the left. Raises ``InputError`` on values out of
    range.
    """

    height: float = KITTI_CAMERA_HEIGHT
    pitch: float = 0.0
    roll: float = 0.0
    yaw: float = 0.0

    def __post_init__(self) -> None:
        check_range("camera.height", self.height, HEIGHT)
        for name in ("pitch", "roll", "yaw"):
            check_range(f"camera.{name}", getattr(self, name), ANGLE)

    def grid_to_camera(self) -> Float[NDArray, "4 4"]:
        """The transform from the grid frame to the camera frame.

        The grid's x axis is the vehicle's. As on KITTI's car, the camera stands 0.27 m ahead of the
        grid frame's origin, which is 1.73 m above the ground.
        """
        ahead = np.linalg.inv(kitti_camera().lidar_to_camera)[0, 3]
        center = np.array([ahead, 0.0, self.height - LIDAR_HEIGHT])
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw, self.pitch, self.roll))
        turn = _about(2, yaw) @ _about(1, -pitch) @ _about(0, roll)
        axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of a level camera
        rotation = (turn @ axes).T
        transform = np.eye(4)
        transform[:3, :3] = rotation
        transform[:3, 3] = -rotation @ center
        return transform


def _about(axis: int, angle: float) -> Float[NDArray, "3 3"]:
    """A rotation about one of the grid's axes."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = math.cos(angle)
    matrix[second, first], matrix[first, second] = math.sin(angle), -math.sin(angle)
    return matrix


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with any lens: ``from_fov``, ``from_intrinsics``, ``from_kitti``, ``from_ros``.

    Attributes:
        projection: 3 x 4, the intrinsics in pixels of images of ``image_size`` and a column that is
            zero but for KITTI's cameras; the centre of the first pixel is 0. None: from ``fov``,
            with the principal point in the image's centre.
        image_size: (height, width) of the images that ``projection`` is for. Images of another size
            and the same aspect are taken as resized ones. None: images of any size.
        fov: horizontal field of view in degrees, of images of any size.
        distortion: OpenCV's coefficients: 4, 5, 8, 12 or 14 of a usual lens, 4 of a fish-eye.
        fisheye: whether the lens follows OpenCV's fish-eye model (ROS and Kalibr: equidistant).
        grid_to_camera: the 4 x 4 transform from the grid frame (x forward, y left, z up; the origin
            is 1.73 m above the ground) to the camera frame (x right, y down, z forward), in metres.
    """

    projection: Float[NDArray, "3 4"] | None = None
    image_size: tuple[int, int] | None = None
    fov: float | None = None
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    grid_to_camera: Float[NDArray, "4 4"] = field(default_factory=lambda: Mount().grid_to_camera())

    # ------------------------------------------------------------------ constructors

    @classmethod
    def from_fov(
        cls,
        fov: float,
        height: float = KITTI_CAMERA_HEIGHT,
        pitch: float = 0.0,
        roll: float = 0.0,
        yaw: float = 0.0,
    ) -> Self:
        """A camera without distortion, by its horizontal field of view in degrees.

        ``height`` and the angles as in ``Mount``. Raises ``InputError`` on values out of range.
        """
        check_range("camera.fov", fov, FIELD_OF_VIEW)
        return cls(fov=float(fov), grid_to_camera=Mount(height, pitch, roll, yaw).grid_to_camera())

    @classmethod
    def from_intrinsics(
        cls,
        matrix: Any,
        image_size: Sequence[int],
        distortion: Any = (),
        fisheye: bool = False,
        height: float = KITTI_CAMERA_HEIGHT,
        pitch: float = 0.0,
        roll: float = 0.0,
        yaw: float = 0.0,
    ) -> Self:
        """A camera by its 3 x 3 intrinsics for images of ``image_size`` (height, width).

        ``matrix`` and ``distortion`` are arrays or nested lists; distortion as in ``Camera``,
        ``height`` and the angles as in ``Mount``. Raises ``InputError`` if they do not describe a
        camera.
        """
        mount = Mount(height, pitch, roll, yaw)
        size = pinhole.check_image_size("camera.image_size", image_size)
        try:
            values = np.asarray(matrix, dtype=np.float64)
            coefficients = np.asarray(distortion, dtype=np.float64).ravel().tolist()
        except (TypeError, ValueError):
            raise InputError("camera: give its matrix and distortion as numbers") from None
        lens = LensFile(values, size, tuple(coefficients), fisheye)
        lens.check("camera")
        return cls._of(lens, mount)

    @classmethod
    def from_kitti(cls, path: Path | str) -> Self:
        """The camera of a KITTI ``calib.txt`` with lines ``P2`` and ``Tr`` (also ``size``).

        Raises ``InputError`` if the file is missing or does not describe a camera.
        """
        given = read_calibration(path)
        return cls(given.projection, given.image_size, grid_to_camera=given.lidar_to_camera)

    @classmethod
    def from_ros(
        cls,
        path: Path | str,
        height: float = KITTI_CAMERA_HEIGHT,
        pitch: float = 0.0,
        roll: float = 0.0,
        yaw: float = 0.0,
    ) -> Self:
        """The camera of a YAML file: a ``camera_info`` of ROS, or one of Kalibr or OpenCV.

        ``height`` and the angles as in ``Mount``. Raises ``InputError`` if the file is missing or
        does not describe a camera that is known here.
        """
        return cls._of(read_lens_file(path), Mount(height, pitch, roll, yaw))

    @classmethod
    def _of(cls, lens: LensFile, mount: Mount) -> Self:
        return cls(
            np.concatenate([lens.matrix, np.zeros((3, 1))], axis=1),
            lens.image_size,
            distortion=lens.distortion,
            fisheye=lens.fisheye,
            grid_to_camera=mount.grid_to_camera(),
        )

    @property
    def undistorted(self) -> bool:
        """Whether the lens is a pinhole."""
        return not self.distortion and not self.fisheye

    # ------------------------------------------------------------------ for an image

    def for_image(self, image_size: tuple[int, int]) -> Self:
        """This camera for images of ``image_size`` (height, width).

        Raises ``InputError`` if they have another aspect than those that it is for.
        """
        height, width = image_size
        if self.projection is None:
            if self.fov is None:
                raise InputError("camera: give its field of view or its intrinsics")
            focal = 0.5 * width / math.tan(math.radians(self.fov) / 2)
            middle = (width - 1) / 2, (height - 1) / 2
            projection = np.array(
                [[focal, 0, middle[0], 0], [0, focal, middle[1], 0], [0, 0, 1, 0]]
            )
            return dataclasses.replace(self, projection=projection, image_size=image_size)
        own_height, own_width = self.image_size or image_size
        u, v = self.projection[:2, 2]
        off_center = abs(u / own_width - 0.5), abs(v / own_height - 0.5)
        if off_center[0] > MAX_OFF_CENTER[0] or off_center[1] > MAX_OFF_CENTER[1]:
            raise InputError(
                f"the image has {width} x {height} pixels, its camera the principal point "
                f"({u:.0f}, {v:.0f}): give the image in its original size, or a calibration "
                "for this size"
            )
        if self.image_size is None:
            _warn_of_unknown_size(float(u), float(v))
            return dataclasses.replace(self, image_size=image_size)
        if self.image_size == image_size:
            return self
        if abs(height - width * own_height / own_width) > 0.5 + SAME_ASPECT * height:
            raise InputError(
                f"the image has {width} x {height} pixels, its camera {own_width} x {own_height}: "
                "give the whole image, or a calibration for this size"
            )
        own = pinhole.Camera(self.projection, self.grid_to_camera, self.image_size)
        projection = pinhole.resize_camera(own, image_size).projection
        return dataclasses.replace(self, projection=projection, image_size=image_size)

    def centered(self) -> Self:
        """The same camera with its optical centre at the origin of its frame."""
        assert self.projection is not None
        transform, projection = self.grid_to_camera.copy(), self.projection.copy()
        transform[:3, 3] += np.linalg.solve(projection[:, :3], projection[:, 3])
        projection[:, 3] = 0.0
        return dataclasses.replace(self, projection=projection, grid_to_camera=transform)

    def project(
        self, rays: Float[NDArray, "*n 3"]
    ) -> tuple[Float[NDArray, "*n 2"], Bool[NDArray, "*n"]]:
        """Pixels (u, v) of directions in the camera frame, and which of them are in the image.

        Directions that the lens does not show have the pixel NaN.
        Needs a ``projection`` and an ``image_size`` (``for_image``).
        """
        assert self.projection is not None
        assert self.image_size is not None
        matrix = self.projection[:, :3]
        flat = np.asarray(rays, dtype=np.float64).reshape(-1, 3)
        radius, forward = np.hypot(flat[:, 0], flat[:, 1]), flat[:, 2]
        angle = np.arctan2(radius, forward)
        valid = angle < self._widest_angle()
        safe = np.where(valid[:, None], flat, [0.0, 0.0, 1.0])
        coefficients = np.asarray(self.distortion or (0.0,) * 4)
        if self.fisheye:
            bent = _equidistant(angle, coefficients)
            along = np.divide(bent, radius, out=np.zeros_like(bent), where=radius > 0)
            pixels = safe[:, :2] * along[:, None] @ matrix[:2, :2].T + matrix[:2, 2]
        else:
            points, _ = cv2.projectPoints(safe, np.zeros(3), np.zeros(3), matrix, coefficients)
            pixels = points[:, 0]
        height, width = self.image_size
        pixels = np.where(valid[:, None], pixels, np.nan)
        with np.errstate(invalid="ignore"):
            valid &= ((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5])).all(1)
        shape = rays.shape[:-1]
        return pixels.reshape(*shape, 2), valid.reshape(shape)

    def _widest_angle(self) -> float:
        """The angle from the axis up to which the lens maps farther rays to farther pixels.

        Beyond it, the polynomials of a distortion turn back, and rays from far outside of the image
        would land in it.
        """
        if self.fisheye:
            angles = np.linspace(0, math.pi, 2000)
            bent = _equidistant(angles, self.distortion or (0.0,) * 4)
        else:
            angles = np.linspace(0, MOST_OFF_AXIS, 2000)
            k = np.zeros(8)
            given = self.distortion[:8]
            k[: len(given)] = given
            squared = np.tan(angles) ** 2
            above = 1 + squared * (k[0] + squared * (k[1] + squared * k[4]))
            below = 1 + squared * (k[5] + squared * (k[6] + squared * k[7]))
            bent = np.tan(angles) * above / below
        turns = np.flatnonzero(np.diff(bent) <= 0)
        return float(angles[turns[0]] if len(turns) else angles[-1])


@functools.cache  # once for each camera
def _warn_of_unknown_size(u: float, v: float) -> None:
    warnings.warn(
        f"the size of the images of the camera with the principal point ({u:g}, {v:g}) is not "
        "known, so a resized or cropped image cannot be noticed: add it to the calibration, in "
        "KITTI's as a line size: 1226 370 (width and height)",
        stacklevel=2,
    )


def _equidistant(
    angle: Float[NDArray, "*n"], k: Sequence[float] | Float[NDArray, " 4"]
) -> Float[NDArray, "*n"]:
    """OpenCV's fish-eye model: the distance from the axis in the image, of rays at an ``angle``."""
    squared = angle**2
    return angle * (1 + squared * (k[0] + squared * (k[1] + squared * (k[2] + squared * k[3]))))
