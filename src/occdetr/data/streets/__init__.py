"""Synthetic streets: a random world of voxels, its picture and its laser scans."""
