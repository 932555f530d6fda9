"""Curves of a reconstruction as they are drawn."""

import numpy as np
from drifting import CENTRE_MM, drifted, hand_sweep, tracked

from speckle3d.scoring.lengths import accumulated
from speckle3d.scoring.references import Reference, sweep_curves
from speckle3d.study.figures import figure_drift

FRAMES = 60


def test_every_mode_the_reference_and_the_95_percent_interval_are_drawn():
    rng = np.random.default_rng(8)
    truth = hand_sweep(rng, FRAMES)
    image, tracker = drifted(truth, rng), tracked(truth, rng)
    deviation = np.linspace(0.0, 0.8, FRAMES)
    covariance = np.zeros((FRAMES, 6, 6))
    # Along z, mm, and tilt, rad; across the images does not count.
    covariance[:, 2, 2], covariance[:, 3, 3] = deviation**2, (0.01 * deviation) ** 2
    covariance[:, 0, 0] = 1e6
    reference = Reference.over_all("tracker", tracker)
    curves = sweep_curves({"image": image, "pose": image}, CENTRE_MM, reference, covariance)
    length, tilt = figure_drift(curves).axes
    motion = accumulated(image, CENTRE_MM)
    values = motion.length_mm, np.rad2deg(motion.tilt_rad)
    widths = deviation, np.rad2deg(0.01 * deviation)
    for axes, value, width in zip((length, tilt), values, widths, strict=True):
        assert [line.get_label() for line in axes.lines] == ["tracker", "image", "pose"]
        np.testing.assert_allclose(axes.lines[1].get_ydata(), value)
        ((path,),) = (band.get_paths() for band in axes.collections)
        span = [np.ptp(path.vertices[path.vertices[:, 0] == k, 1]) for k in range(1, FRAMES)]
        np.testing.assert_allclose(span, 2 * 1.96 * width[1:], atol=1e-9)
