"""Samples to orientation: inclination without the magnetometer, heading by it, and VQF beside both."""
