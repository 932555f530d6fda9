"""Length from an accelerometer and a gyroscope on the probe: image steps tied to m/s^2."""
