"""Numba kernels on bare arrays."""
