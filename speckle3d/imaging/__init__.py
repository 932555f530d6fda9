"""Frames with poses to voxels, cuts, surfaces and measures."""
