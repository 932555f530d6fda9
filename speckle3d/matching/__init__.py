"""From images to pair correlations: intensity, quality, in-plane motion, which pairs, and their correlation."""
