"""Frames with poses to a grid of voxels."""
