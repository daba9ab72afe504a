"""The edges of 3D boxes as lines in an image, clipped at the camera plane and the image's border.

Cameras have NumPy arrays without batch axes. They may be affine, with (0, 0, 0, 1) as the last row
of the projection: then every depth is 1, as in a map.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from occdetr.geometry.camera import MIN_DEPTH, Camera

_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
#: The 12 pairs of corners that differ in one coordinate.
EDGES = np.array(
    [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1]
)


def box_edges(boxes3d: Float[np.ndarray, "box 6"]) -> Float[np.ndarray, "box 12 2 3"]:
    """Both ends of the 12 edges of (centre, size) boxes, in the boxes' units."""
    corners = boxes3d[:, None, :3] + _CORNERS * boxes3d[:, None, 3:]
    return corners[:, EDGES].astype(np.float64)


def to_homogeneous(
    points: Float[np.ndarray, "*batch 3"], camera: Camera
) -> Float[np.ndarray, "*batch 3"]:
    """Grid-frame points in metres -> (u * depth, v * depth, depth); pixels as in ``camera.py``."""
    matrix = np.asarray(camera.projection) @ np.asarray(camera.lidar_to_camera)
    return points @ matrix[:, :3].T + matrix[:, 3]


def clip_segments(
    segments: Float[np.ndarray, "segment 2 3"], camera: Camera
) -> tuple[Int[np.ndarray, " kept"], Float[np.ndarray, "kept 2 3"]]:
    """The part of each segment (grid frame, metres) inside the camera's image.

    Returns the indices of the segments that have one, and its two ends. Segments are clipped in
    homogeneous coordinates (Blinn and Newell 1978), where the camera plane and the image's borders
    are all planes, so segments that pass the camera are no special case.
    """
    height, width = camera.image_size
    u, v, depth = np.moveaxis(to_homogeneous(segments, camera), -1, 0)  # each segment, 2
    inside = np.stack(
        [
            depth - MIN_DEPTH,
            u + 0.5 * depth,
            (width - 0.5) * depth - u,
            v + 0.5 * depth,
            (height - 0.5) * depth - v,
        ]
    )  # 5, segment, 2: not negative on the inner side of each plane
    first, last = inside[..., 0], inside[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = first / (first - last)
    enters = np.where((first < 0) & (last >= 0), crossing, 0.0).max(0)
    leaves = np.where((first >= 0) & (last < 0), crossing, 1.0).min(0)
    outside = ((first < 0) & (last < 0)).any(0)
    kept = np.flatnonzero(~outside & (enters < leaves))
    start, along = segments[kept, 0], segments[kept, 1] - segments[kept, 0]
    cuts = [start + share[kept, None] * along for share in (enters, leaves)]
    return kept, np.stack(cuts, axis=1)


def sample_segments(
    segments: Float[np.ndarray, "segment 2 3"], camera: Camera, number: int
) -> Float[np.ndarray, "segment number 3"]:
    """``number`` points on each segment (grid frame, metres), evenly spaced in the image.

    The segments are in front of the camera plane, as ``clip_segments`` returns them.
    """
    near, far = np.moveaxis(to_homogeneous(segments, camera)[..., 2:], 1, 0)  # segment, 1
    share = np.linspace(0, 1, number)
    along = (share * near / (share * near + (1 - share) * far))[..., None]
    return segments[:, :1] * (1 - along) + segments[:, 1:] * along


def in_front_of(
    points: Float[np.ndarray, "*batch 3"],
    depth: Float[np.ndarray, "height width"],
    camera: Camera,
    tolerance: float,
) -> Bool[np.ndarray, "*batch"]:
    """Which points (grid frame, metres) are not hidden by a surface.

    ``depth`` is the depth image of ``camera`` in metres, infinite where nothing is. A surface hides
    a point if it is more than ``tolerance`` metres nearer. Points outside the image are compared
    with the nearest pixel.
    """
    homogeneous = to_homogeneous(points, camera)
    own = homogeneous[..., 2]
    pixels = np.rint(homogeneous[..., :2] / own[..., None].clip(MIN_DEPTH)).astype(int)
    column = pixels[..., 0].clip(0, depth.shape[1] - 1)
    row = pixels[..., 1].clip(0, depth.shape[0] - 1)
    return own <= depth[row, column] + tolerance
