"""Files that describe a lens: ``camera_info`` of ROS, and the YAML files of Kalibr and OpenCV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from occdetr.errors import InputError
from occdetr.files import read_text

#: Names of distortion models: those of usual lenses, and of fish-eyes.
USUAL = ("plumb_bob", "rational_polynomial", "radtan", "none", "")
FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
#: What a file that is no calibration makes the readers raise.
_UNREADABLE = (
    *(yaml.YAMLError, cv2.error, SystemError, TypeError, ValueError, LookupError),
    *(OverflowError, RecursionError),
)
NUMBERS = (0, 4, 5, 8, 12, 14)  # of coefficients, in OpenCV's order


@dataclass(frozen=True)
class LensFile:
    """What such a file says; see ``occdetr.api.camera.Camera``."""

    matrix: NDArray[np.float64]
    image_size: tuple[int, int] | None
    distortion: tuple[float, ...]
    fisheye: bool

    def check(self, name: str) -> None:
        """Raises ``InputError``, which begins with ``name``, if this is no lens."""
        if self.matrix.shape != (3, 3) or not np.isfinite(self.matrix).all():
            raise InputError(f"{name}: its intrinsics must be 3 x 3 finite numbers")
        if min(self.matrix[0, 0], self.matrix[1, 1]) <= 0 or self.matrix[2].tolist() != [0, 0, 1]:
            raise InputError(
                f"{name}: its intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, "
                "with fx and fy above 0"
            )
        allowed = (0, 4) if self.fisheye else NUMBERS
        if len(self.distortion) not in allowed or not np.isfinite(self.distortion).all():
            raise InputError(
                f"{name}: {len(self.distortion)} distortion coefficients: give "
                f"{' or '.join(map(str, allowed))} numbers, in OpenCV's order"
            )
        if self.matrix[0, 1] or self.matrix[1, 0]:
            raise InputError(f"{name}: its intrinsics have a skew, which is not known here")
        if self.image_size is not None and min(self.image_size) < 1:
            raise InputError(f"{name}: its image size must be above 0")


def is_lens_file(path: Path | str) -> bool:
    """Whether a file is one of these, by its suffix."""
    return Path(path).suffix.lower() in (".yaml", ".yml", ".xml")


def read_lens_file(path: Path | str) -> LensFile:
    """The lens of a YAML file. Raises ``InputError`` if it is missing or not such a file."""
    text = "\n".join(read_text(path))
    try:
        of_opencv = text.startswith(("%YAML:1.0", "<?xml")) or "opencv-matrix" in text
        documents = [_read_opencv(path)] if of_opencv else yaml.safe_load_all(text)
        content = next((each for each in documents if each is not None), None)
        if not isinstance(content, Mapping):
            raise InputError("has no named entries")
        lens = _lens(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _UNREADABLE as error:
        raise InputError(f"{path}: cannot be read as a calibration") from error
    lens.check(str(path))
    return lens


def _lens(content: Mapping[str, Any]) -> LensFile:
    cameras = [
        value
        for key, value in content.items()
        if str(key).startswith("cam") and isinstance(value, Mapping) and "intrinsics" in value
    ]
    if cameras:
        return _kalibr(cameras)
    content = {str(key).lower(): value for key, value in content.items()}
    matrix = _first(content, "camera_matrix", "cameramatrix", "k", "mtx")
    if matrix is None:
        raise InputError(
            "has no camera_matrix: give a camera_info of ROS, a camchain of Kalibr, or a "
            "calibration of OpenCV"
        )
    model = str(_first(content, "distortion_model") or "").lower()
    coefficients = _first(
        content, "distortion_coefficients", "distcoeffs", "dist_coeffs", "dist", "d"
    )
    fisheye = _is_fisheye(model) or bool(content.get("fisheye_model"))  # of OpenCV's sample
    size = [
        _first(content, *names) for names in (("image_height", "height"), ("image_width", "width"))
    ]
    return LensFile(
        np.asarray(_numbers(matrix), dtype=np.float64).reshape(3, 3),
        None if size == [None, None] else (int(size[0]), int(size[1])),
        _without_zeros(_numbers(coefficients if coefficients is not None else [])),
        fisheye,
    )


def _kalibr(cameras: Sequence[Mapping[str, Any]]) -> LensFile:
    if len(cameras) > 1:
        raise InputError(f"has {len(cameras)} cameras: keep one of them")
    camera = cameras[0]
    if (model := str(camera.get("camera_model", "pinhole"))) != "pinhole":
        raise InputError(f"camera_model {model} is not known: calibrate with pinhole")
    fx, fy, cx, cy = map(float, camera["intrinsics"])
    width, height = camera.get("resolution", (None, None))
    return LensFile(
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        None if width is None else (int(height), int(width)),
        _without_zeros(_numbers(camera.get("distortion_coeffs", []))),
        _is_fisheye(str(camera.get("distortion_model", "")).lower()),
    )


def _is_fisheye(model: str) -> bool:
    if model not in (*USUAL, *FISHEYE):
        raise InputError(f"distortion_model {model} is not known: use plumb_bob or equidistant")
    return model in FISHEYE


def _first(content: Mapping[str, Any], *names: str) -> Any:
    return next((content[name] for name in names if content.get(name) is not None), None)


def _numbers(value: Any) -> list[float]:
    """The numbers of a list, of nested lists, or of ROS's and OpenCV's ``data``."""
    if isinstance(value, Mapping):
        value = value["data"]
    return [float(number) for number in np.asarray(value, dtype=np.float64).ravel()]


def _without_zeros(coefficients: Sequence[float]) -> tuple[float, ...]:
    return tuple(coefficients) if any(coefficients) else ()


def _read_opencv(path: Path | str) -> dict[str, Any]:
    """The numbers and matrices of a file that OpenCV's ``FileStorage`` has written."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    try:
        root, content = storage.root(), {}
        for name in root.keys():  # noqa: SIM118
            node = root.getNode(name)
            if node.isMap():
                if not node.getNode("dt").empty():  # another map is no matrix
                    content[name] = node.mat()
            elif node.isInt() or node.isReal():
                content[name] = node.real()
            elif node.isString():
                content[name] = node.string()
        return content
    finally:
        storage.release()
