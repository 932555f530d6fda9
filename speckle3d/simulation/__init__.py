"""Simulated sweeps with truth."""
