"""Kernels of the orientation sensor: inclination by a Kalman filter, its smoothing, and the heading."""
