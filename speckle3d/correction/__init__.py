"""Drift correction of a trajectory by a sensor."""
