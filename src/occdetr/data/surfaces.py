"""The first labelled surface on the ray of each block of pixels: what an image shows of a grid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from occdetr.classes import IGNORE
from occdetr.data.semantickitti import Calibration
from occdetr.geometry.camera import transform_points
from occdetr.geometry.raycast import camera_rays, cast_rays, metres_to_voxels
from occdetr.geometry.voxels import VOXEL_SIZE


def first_surfaces(
    labels: UInt8[NDArray, "x y z"],
    calibration: Calibration,
    image_size: tuple[int, int],
    stride: int,
) -> tuple[Float32[NDArray, "row column"], UInt8[NDArray, "row column"]]:
    """Depth (metres along the camera's axis, infinite if there is none) and class (0 if there is
    none, 255 if it is unknown) of the first occupied or unknown voxel on the ray through each
    block of ``stride`` x ``stride`` pixels; partial blocks at the right and the bottom are unknown.
    """
    rows, columns = image_size[0] // stride, image_size[1] // stride
    to_camera = calibration.lidar_to_camera
    origins, directions = camera_rays(calibration.projection, to_camera, image_size, stride)
    hits, distances, _ = cast_rays(labels, metres_to_voxels(origins), directions)
    met = np.flatnonzero(hits[:, 0] >= 0)
    points = origins[met] + VOXEL_SIZE * distances[met, None] * directions[met]
    shape = (-(-image_size[0] // stride), -(-image_size[1] // stride))
    depth = np.full(shape, np.inf, dtype=np.float32)
    kind = np.full(shape, IGNORE, dtype=np.uint8)
    own_depth, own_kind = np.full(len(hits), np.inf), np.zeros(len(hits), dtype=np.uint8)
    own_depth[met] = transform_points(points, to_camera)[:, 2]
    own_kind[met] = labels[tuple(hits[met].T)]
    depth[:rows, :columns] = own_depth.reshape(rows, columns)
    kind[:rows, :columns] = own_kind.reshape(rows, columns)
    return depth, kind
