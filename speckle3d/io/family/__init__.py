"""Own HDF5 files: sweeps, reconstructions, calibrations and curves."""
