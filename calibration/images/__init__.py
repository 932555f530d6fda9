"""Calibration without a phantom, from two crossing sweeps."""
