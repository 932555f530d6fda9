"""Pictures of a calibration from images: cuts show what the image shows."""

import crossing_scenes
import numpy as np

from calibration.images.report import pictures


def test_a_cut_with_the_right_calibration_is_like_the_image():
    first, second, truth = crossing_scenes.crossing_sweeps(7, frames=36, jitter=(0.0, 0.0), speckle=False)
    off = crossing_scenes.displaced(truth, np.random.default_rng(2), 6.0, 6.0)
    shown = pictures(first, second, 18, off, truth)
    likeness = []
    for cut in (shown.before, shown.after):
        both = np.isfinite(cut) & np.isfinite(shown.image)
        assert both.mean() > 0.1
        likeness.append(np.corrcoef(cut[both], shown.image[both])[0, 1])
    # The same voxels without speckle: only linear interpolation between frames 0.7 mm apart is between them.
    assert likeness[1] > 0.95
    assert likeness[0] < likeness[1] - 0.1
