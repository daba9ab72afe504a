"""Videos: their frames as images, and pictures as a video."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from occdetr.data.find_images import SUFFIXES as IMAGE_SUFFIXES
from occdetr.errors import InputError
from occdetr.files import check_folder, temporary_name

#: Files that are read as videos, by their suffix in lower case.
VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".ts"),
    *(".mts", ".m2ts", ".3gp", ".wmv", ".flv"),
)
#: OpenCV's name of the codec of a written video, by its suffix: those that every build of it has.
CODECS = {".mp4": "mp4v", ".avi": "MJPG"}
LOWEST_RATE, HIGHEST_RATE = 0.1, 240.0  # frames a second that are believed
LEAST_SHARE = 0.98  # of the frames that a file's header announces, which some count roughly
USUAL_RATE = 25.0  # of a video that does not say

Image = UInt8[NDArray, "height width 3"]

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # it would print beside our errors


def is_video(path: Path | str) -> bool:
    """Whether a file is a video: by its suffix, or, if that is unknown, by having two frames."""
    suffix = Path(path).suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return True
    if suffix in IMAGE_SUFFIXES or not Path(path).is_file():
        return False
    capture = cv2.VideoCapture(str(path))
    found = capture.grab() and capture.grab()
    capture.release()
    return found


class Video:
    """The frames of a video file: ``for number, image in Video("drive.mp4", step=5)``.

    ``step``: every so many frames is given. Images are RGB, turned as the file says. ``rate``:
    frames a second of the file. ``count``: about how many frames are given; 0 if the file does not
    say. ``problem``: after the last frame, one line if the file ends early; it is a warning too.

    Raises ``InputError`` if the file is missing or is no video.
    """

    def __init__(self, path: Path | str, step: int = 1) -> None:
        self.path, self.step = Path(path), step
        if not self.path.is_file():
            raise InputError(f"{path}: file is missing: check the path")
        capture = cv2.VideoCapture(str(path))
        opened, first = capture.isOpened(), False
        if opened:
            first, _ = capture.read()
        rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        capture.release()
        if not first:
            raise InputError(
                f"{path}: no frame can be read: copy it again, or convert it to an .mp4 of H.264"
            )
        self.rate = float(rate) if LOWEST_RATE <= rate <= HIGHEST_RATE else USUAL_RATE
        self.total = int(count) if 0 < count < 1e9 else 0
        self.count = -(-self.total // step)
        self.problem: str | None = None

    def __iter__(self) -> Iterator[tuple[int, Image]]:
        capture, number = cv2.VideoCapture(str(self.path)), 0
        try:
            while capture.grab():
                if number % self.step == 0:
                    decoded, image = capture.retrieve()
                    if not decoded:
                        break
                    yield number, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                number += 1
        finally:
            capture.release()
        if number < LEAST_SHARE * self.total:
            self.problem = (
                f"{self.path}: only {number} of {self.total} frames could be read: copy or convert "
                "it again"
            )
            warnings.warn(self.problem, stacklevel=2)


def count_frames(file: Path) -> int:
    """The number of frames that can be read; 0 if the file is no video."""
    capture, number = cv2.VideoCapture(str(file)), 0
    while capture.grab():
        number += 1
    capture.release()
    return number


class VideoFile:
    """A video that is written picture by picture; all have the size of the first.

    It has its name when it is closed, so that an interrupted one leaves no half file:
    ``with VideoFile("out.mp4", rate=10) as video: video.add(image)``. ``rate``: pictures a second.

    Raises ``InputError`` for a suffix other than those of ``CODECS``, if the codec is missing, or,
    at the end, if a picture could not be written: OpenCV does not report a full disk.
    """

    def __init__(self, file: Path | str, rate: float) -> None:
        self.file, self.rate = Path(file), rate
        if self.file.suffix.lower() not in CODECS:
            raise InputError(f"video={file}: give a file with {' or '.join(CODECS)}")
        check_folder("video", self.file.parent, writable=True)
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.part = temporary_name(self.file).with_suffix(self.file.suffix)  # FFmpeg goes by it
        self.writer: cv2.VideoWriter | None = None
        self.count = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.writer is None:
            return
        self.writer.release()
        try:
            if kind is None:
                self._check_written()
                os.replace(self.part, self.file)
        finally:
            self.part.unlink(missing_ok=True)

    def _check_written(self) -> None:
        found = count_frames(self.part)
        if found < self.count:
            raise InputError(
                f"video={self.file}: only {found} of {self.count} pictures could be written: free "
                "some space, or choose a folder on another disk"
            )

    def add(self, image: Image) -> None:
        """Add an RGB picture. Raises ``InputError`` if it cannot be encoded."""
        if self.writer is None:
            size = (image.shape[1], image.shape[0])
            codec = cv2.VideoWriter.fourcc(*CODECS[self.file.suffix.lower()])
            self.writer = cv2.VideoWriter(str(self.part), codec, self.rate, size)
            if not self.writer.isOpened():
                raise InputError(f"video={self.file}: OpenCV has no encoder for it: give an .avi")
        self.writer.write(np.ascontiguousarray(image[..., ::-1]))
        self.count += 1
