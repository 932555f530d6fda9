"""Commands that calibrate: curves, and where sensors sit on the probe."""
