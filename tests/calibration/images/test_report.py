"""Pictures of a calibration from images: the published figure 2, and cuts that show what the image shows."""

import crossing_scenes
import numpy as np
import pytest

from calibration.images.angulation import translation_errors_mm
from calibration.images.report import figure_reconstruction_error, pictures


def test_the_published_figure_shows_equations_9_to_11():
    shifts, turns = figure_reconstruction_error().axes
    # With the published point beta is alpha, -30 degrees.
    expected = translation_errors_mm([20.0, 20.0, 20.0], -np.pi / 6, -np.pi / 6)
    for line, value in zip(shifts.lines, expected, strict=True):
        assert line.get_ydata()[-1] == pytest.approx(value, rel=1e-6)
        assert line.get_ydata()[len(line.get_ydata()) // 2] == pytest.approx(0.0, abs=1e-9)
    assert len(turns.lines) == 3
    # At the point of the figure, twenty degrees about any axis move the two images apart by centimetres.
    assert all(line.get_ydata()[-1] > 5.0 for line in turns.lines)


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
