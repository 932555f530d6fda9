"""A live sensor on a port: configuration, recording to a crash-safe file, display of its state."""
