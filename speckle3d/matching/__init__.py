"""Images to pair correlations: intensity, frame quality, in-plane motion, which pairs, blocks."""
