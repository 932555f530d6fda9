"""A sweep as volumes and sequences of images in files, and as a scene for 3D Slicer."""
