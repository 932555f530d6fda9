"""Samples to orientation: filter, smoother, detectors of rest and magnetic disturbance."""
