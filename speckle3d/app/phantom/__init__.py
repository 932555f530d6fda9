"""Detection on images of a phantom, tuned and corrected by hand, and the calibration from it."""
