"""The trajectory of the car: its poses, and the positions of its later LiDAR sweeps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from occdetr.streets.ground import SENSOR_HEIGHT, Plan, road_height
from occdetr.streets.layout import Layout

SWEEPS = np.arange(2.0, 60.0, 2.5)  # metres ahead of a scan at which later sweeps are taken
WHEELBASE = 2.7


def ego_pose(layout: Layout, plan: Plan, along: float) -> Float[np.ndarray, "4 4"]:
    """The LiDAR's pose after ``along`` metres of road: its frame to the world frame.

    The car keeps its lane and its initial angle to the road. Its pitch is the slope of the road
    between its axles.
    """
    here = layout.start + along
    x, y, heading = layout.road.point(here, layout.lane)
    yaw = heading - float(layout.road.heading(layout.start))
    front = road_height(plan, here + WHEELBASE / 2, layout.lane)
    back = road_height(plan, here - WHEELBASE / 2, layout.lane)
    ahead = np.array([np.cos(yaw), np.sin(yaw), (front - back) / WHEELBASE])
    ahead /= np.linalg.norm(ahead)
    left = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([ahead, left, np.cross(ahead, left)], axis=1)
    pose[:3, 3] = x, y, (front + back) / 2 + SENSOR_HEIGHT
    return pose


def sweep_places(
    layout: Layout, plan: Plan, along: float, pose: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "sweep 3"]:
    """The positions of later sweeps in the frame of a pose (metres)."""
    places = np.stack([ego_pose(layout, plan, along + float(s))[:3, 3] for s in SWEEPS])
    return (places - pose[:3, 3]) @ pose[:3, :3]
