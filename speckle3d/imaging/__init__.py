"""Voxels and reslices from frames with poses."""
