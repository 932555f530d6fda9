"""Curves of a reconstruction as they are drawn."""

import numpy as np
import pytest
from drifting import CENTRE_MM, drifted, hand_sweep, tracked

from speckle3d.scoring.lengths import accumulated
from speckle3d.scoring.references import Reference, sweep_curves
from speckle3d.study.figures import figure_drift

FRAMES = 60


@pytest.fixture(scope="module")
def sweep():
    rng = np.random.default_rng(8)
    truth = hand_sweep(rng, FRAMES)
    return drifted(truth, rng), tracked(truth, rng)


def test_every_mode_the_reference_and_the_95_percent_interval_are_drawn_and_named(sweep):
    image, tracker = sweep
    deviation = np.linspace(0.0, 0.8, FRAMES)
    covariance = np.zeros((FRAMES, 6, 6))
    # Along z, mm, and tilt, rad; across the images does not count.
    covariance[:, 2, 2], covariance[:, 3, 3] = deviation**2, (0.01 * deviation) ** 2
    covariance[:, 0, 0] = 1e6
    reference = Reference.over_all("tracker", tracker)
    curves = sweep_curves({"image": image, "pose": image}, CENTRE_MM, reference, covariance)
    figure = figure_drift(curves)
    length, tilt = figure.axes
    (legend,) = figure.legends
    names = ["tracker", "95 % interval of image", "image", "pose"]
    assert [text.get_text() for text in legend.get_texts()] == names
    widths = deviation, np.rad2deg(0.01 * deviation)
    motion = accumulated(image, CENTRE_MM)
    for axes, width, values in zip(
        (length, tilt), widths, (motion.length_mm, np.rad2deg(motion.tilt_rad)), strict=True
    ):
        assert [line.get_label() for line in axes.lines] == ["tracker", "image", "pose"]
        np.testing.assert_allclose(axes.lines[1].get_ydata(), values)
        (band,) = axes.collections
        (path,) = band.get_paths()
        span = [np.ptp(path.vertices[path.vertices[:, 0] == k, 1]) for k in range(1, FRAMES)]
        np.testing.assert_allclose(span, 2 * 1.96 * width[1:], atol=1e-9)
