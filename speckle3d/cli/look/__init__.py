"""Commands that look at results: voxels, cuts, surfaces, measures, scenes, the browser."""
