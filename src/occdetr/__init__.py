"""OccupancyDETR: one camera image -> 256 x 256 x 32 semantic voxels."""

__version__ = "0.1.0"
