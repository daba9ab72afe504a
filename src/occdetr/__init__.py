"""OccupancyDETR: one camera image -> 256 x 256 x 32 semantic voxels."""

import os

__version__ = "0.1.0"

#: Largest number of pixels of an image file, which bounds the memory that decoding it takes.
MAX_PIXELS = 2**27

os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # read when OpenCV is loaded
