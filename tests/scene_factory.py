"""Small scenes of known content for the tests of the data modules."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from occdetr.classes import CLASS_NAMES
from occdetr.data.frames import Frame, find_frames
from occdetr.data.semantickitti import write_labels, write_mask
from occdetr.files import write_image
from occdetr.geometry.camera import Camera
from occdetr.geometry.kitti import write_calibration
from occdetr.geometry.voxels import GRID_SHAPE, points_to_indices

IMAGE_SIZE = (120, 400)
REAL_ROOT = Path(__file__).parents[1] / "data" / "semantickitti-mini"
REAL_SEQUENCES = ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10")

#: A slightly rotated camera with a fourth column of the projection, as KITTI's.
CAMERA = Camera(
    projection=np.array(
        [[230.0, 0.0, 197.0, 14.0], [0.0, 230.0, 58.0, 0.05], [0.0, 0.0, 1.0, 0.005]]
    ),
    lidar_to_camera=np.array(
        [
            [0.0012, -0.99997, -0.0075, -0.01],
            [-0.0070, 0.0075, -0.99995, -0.07],
            [0.99997, 0.0013, -0.0070, -0.30],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
    image_size=IMAGE_SIZE,
)


def empty_grid() -> np.ndarray:
    return np.zeros(GRID_SHAPE, dtype=np.uint8)


def put_box(
    labels: np.ndarray, name: str, center: Sequence[float], size: Sequence[float]
) -> np.ndarray:
    """Fill a box (grid-frame metres) with a class, in place; returns the voxels as [V, 3]."""
    half = np.array(size) / 2
    lower = points_to_indices(np.array(center) - half + 1e-6).clip(0)
    upper = points_to_indices(np.array(center) + half - 1e-6) + 1
    box = tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))
    labels[box] = CLASS_NAMES.index(name)
    inside = np.zeros(labels.shape, dtype=bool)
    inside[box] = True
    return np.argwhere(inside)


def street(shift: float = 0.0) -> np.ndarray:
    """A road, a car to the left, a pole to the right."""
    labels = empty_grid()
    put_box(labels, "road", (25.6, 0.0, -1.7), (51.2, 8.0, 0.2))
    put_box(labels, "car", (14.0 + shift, 3.0, -0.8), (4.0, 1.8, 1.6))
    put_box(labels, "pole", (11.0, -4.1, -0.2), (0.2, 0.2, 2.8))
    return labels


def shadows(labels: np.ndarray) -> np.ndarray:
    """Voxels at or below an occupied one, as those that no ray has reached."""
    return np.maximum.accumulate(labels[:, :, ::-1], axis=2)[:, :, ::-1] > 0


def one_late(grid: np.ndarray) -> np.ndarray:
    """A grid as SemanticKITTI's release 1.0 wrote it: from the second voxel of the file on."""
    flat = np.zeros_like(grid).reshape(-1)
    flat[1:] = grid.reshape(-1)[:-1]
    return flat.reshape(grid.shape)


def write_dataset(
    root: Path, sequence: str = "00", num_frames: int = 3, image_size: tuple[int, int] = IMAGE_SIZE
) -> list[Frame]:
    """Streets in SemanticKITTI's layout, numbered 0, 5, 10, ..."""
    folder = root / "sequences" / sequence
    write_calibration(folder / "calib.txt", CAMERA)
    rng = np.random.default_rng(int(sequence))
    for index in range(num_frames):
        name = f"{index * 5:06d}"
        image = rng.integers(0, 255, (*image_size, 3), dtype=np.uint8)
        write_image(folder / "image_2" / f"{name}.png", image)
        write_labels(folder / "voxels" / f"{name}.label", street(shift=2.0 * index))
        write_mask(folder / "voxels" / f"{name}.invalid", empty_grid())
        write_mask(folder / "voxels" / f"{name}.bin", street() > 0)
    return find_frames(root, [sequence])


def project_brute_force(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [N, 2] and depths [N] of grid-frame points [N, 3], by plain matrix products."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    rows = homogeneous @ (camera.projection @ camera.lidar_to_camera).T
    return rows[:, :2] / rows[:, 2:], rows[:, 2]


def write_frame(
    root: Path, sequence: str, name: str, kinds: Sequence[str] = ("label", "invalid", "bin")
) -> None:
    """Empty files of a frame, and a ``calib.txt``."""
    folder = root / "sequences" / sequence
    files = [folder / "voxels" / f"{name}.{kind}" for kind in kinds]
    for path in [folder / "image_2" / f"{name}.png", *files]:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    if not (folder / "calib.txt").exists():
        write_calibration(folder / "calib.txt", CAMERA)


def one_line_error(caught: Any, *parts: object) -> bool:
    """Whether the message of a caught exception is one line; asserts that it has all ``parts``."""
    message = str(caught.value)
    for part in parts:
        assert str(part) in message
    return "\n" not in message
