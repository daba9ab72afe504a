"""The edges of 3D boxes as lines in a picture, cut at the camera plane and at the border.

A camera is a pair (projection 3 x 4, lidar_to_camera 4 x 4). It may be affine, with (0, 0, 0, 1)
as last row of its projection: then every depth is 1, as in a map.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from occdetr.geometry.camera import MIN_DEPTH

#: Projection (3, 4) and lidar_to_camera (4, 4) of a camera.
Camera = tuple[np.ndarray, np.ndarray]

_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
#: The 12 pairs of corners that differ in one coordinate.
EDGES = np.array(
    [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1]
)


def box_edges(boxes3d: Float[np.ndarray, "box 6"]) -> Float[np.ndarray, "box 12 2 3"]:
    """Both ends of the edges of (centre, size) boxes, in the boxes' own units."""
    corners = boxes3d[:, None, :3] + _CORNERS * boxes3d[:, None, 3:]
    return corners[:, EDGES].astype(np.float64)


def to_homogeneous(
    points: Float[np.ndarray, "*batch 3"], camera: Camera
) -> Float[np.ndarray, "*batch 3"]:
    """Grid-frame points in metres -> (u * depth, v * depth, depth); pixels as in ``camera.py``."""
    matrix = camera[0] @ camera[1]
    return points @ matrix[:, :3].T + matrix[:, 3]


def clip_segments(
    segments: Float[np.ndarray, "segment 2 3"], camera: Camera, size: tuple[int, int]
) -> tuple[Int[np.ndarray, " kept"], Float[np.ndarray, "kept 2 3"]]:
    """The part of each segment (grid frame, metres) inside an image of ``size`` (height, width).

    Returns which segments have one, and its two ends. Cut in homogeneous coordinates (Blinn and
    Newell 1978), where camera plane and image borders are all planes, so that a segment that passes
    the camera needs no case of its own.
    """
    height, width = size
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
    """``number`` points on each segment (grid frame, metres), evenly spaced in the picture.

    The segments lie in front of the camera plane, as ``clip_segments`` leaves them.
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
    """Which points (grid frame, metres) no surface hides.

    ``depth`` (metres, infinite where nothing is) is of the picture of ``camera``; a surface nearer
    by up to ``tolerance`` metres hides nothing. Outside the picture the nearest pixel decides.
    """
    homogeneous = to_homogeneous(points, camera)
    own = homogeneous[..., 2]
    pixels = np.rint(homogeneous[..., :2] / own[..., None].clip(MIN_DEPTH)).astype(int)
    column = pixels[..., 0].clip(0, depth.shape[1] - 1)
    row = pixels[..., 1].clip(0, depth.shape[0] - 1)
    return own <= depth[row, column] + tolerance
