"""Files: sweeps, image sequences, reconstructions, volumes. Readers are chosen by what a file holds."""
