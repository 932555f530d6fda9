"""Ground floor: geometry, streams, sweeps, least squares, errors."""
