"""From samples to orientation."""
