"""The browser app: sweeps, reconstructions, phantoms and sensors to look at, and to tune what is detected."""
