"""Planes and curved sheets through a sweep, and what frames or voxels show there."""
