"""One estimate from all that is known: images, orientation sensor, tracker and evidence of the scale."""

from speckle3d.correction.fused.fuse import FusedPoses, FusedSettings, fuse

__all__ = ["FusedPoses", "FusedSettings", "fuse"]
