"""Files: sweeps, curves, reconstructions, volumes."""
