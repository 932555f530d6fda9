"""Pictures of a calibration from images: cuts show what the image shows."""

import crossing_scenes
import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.images.report import PIXEL_MM, cut_of
from speckle3d.imaging.cuts.planes import image_plane
from speckle3d.imaging.cuts.reslice import reslice_frames


def test_a_cut_with_the_right_calibration_is_like_the_image():
    first, second, truth = crossing_scenes.crossing_sweeps(7, frames=36, jitter=(0.0, 0.0), speckle=False)
    off = crossing_scenes.displaced(truth, np.random.default_rng(2), 6.0, 6.0)
    still = RigidTransform.identity(1)
    image = reslice_frames(
        first.images[18:19], first.grid, still, image_plane(still[0], first.grid, PIXEL_MM), 1.0
    )
    likeness = []
    for pose in (off, truth):
        cut = cut_of(first, second, 18, pose)
        both = np.isfinite(cut) & np.isfinite(image)
        assert both.mean() > 0.1
        likeness.append(np.corrcoef(cut[both], image[both])[0, 1])
    # The same voxels without speckle: only linear interpolation between frames 0.7 mm apart is between them.
    assert likeness[1] > 0.95
    assert likeness[0] < likeness[1] - 0.1
