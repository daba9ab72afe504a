"""The trajectory of the car: its poses, and the positions of its later LiDAR sweeps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from occdetr.streets.ground import SENSOR_HEIGHT, Plan, road_height
from occdetr.streets.layout import Layout

SWEEPS = np.arange(2.0, 60.0, 2.5)  # metres ahead of a scan at which later sweeps are taken
WHEELBASE = 2.7


@dataclass(frozen=True)
class Tilt:
    """How the sensors are tilted against the road, in degrees: their front down and their left up,
    each with its standard deviation."""

    down: float
    down_spread: float
    left_up: float
    left_up_spread: float


#: With the streets' own slopes, the planes of the road in 14 real frames (docs/synthetic.md).
KITTI_TILT = Tilt(down=0.4, down_spread=0.2, left_up=0.9, left_up_spread=0.6)


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


def draw_tilt(rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """How the sensors of a car are tilted against the road: their frame to the level frame."""
    tilt = KITTI_TILT
    down = np.radians(tilt.down + tilt.down_spread * rng.normal())
    left_up = np.radians(tilt.left_up + tilt.left_up_spread * rng.normal())
    about_y, about_x = np.eye(4), np.eye(4)
    about_y[:3:2, :3:2] = [[np.cos(down), np.sin(down)], [-np.sin(down), np.cos(down)]]
    about_x[1:3, 1:3] = [[np.cos(left_up), -np.sin(left_up)], [np.sin(left_up), np.cos(left_up)]]
    return about_y @ about_x


def sweep_places(
    layout: Layout, plan: Plan, along: float, pose: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "sweep 3"]:
    """The positions of later sweeps in the frame of a pose (metres)."""
    places = np.stack([ego_pose(layout, plan, along + float(s))[:3, 3] for s in SWEEPS])
    return (places - pose[:3, 3]) @ pose[:3, :3]
