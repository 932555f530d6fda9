"""Cuts through a reconstruction: where they lie, made from voxels or frames, and drawn."""
