"""Correlations of frame pairs to a trajectory, one module per stage."""
