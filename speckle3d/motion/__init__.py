"""From RF frames to a trajectory, one module per stage."""
