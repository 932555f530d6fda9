"""The orientation sensor: usable without speckle3d's upper floors."""
