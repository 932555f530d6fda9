"""From a port to a crash-safe file."""
