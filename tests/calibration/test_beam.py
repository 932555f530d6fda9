"""The bias of a thick beam on a bare wall: prediction against scans with such a beam."""

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, TRIAL_1, scan_plane

from calibration.beam import predict_bias
from calibration.plane import calibrate_plane
from calibration.settings import PlaneFit


def moved_mm(chain, columns_and_rows):
    """Displacement of a pixel from where the true mounting has it, along the image's axes."""
    before, after = (
        mounting.apply(np.append(columns_and_rows * pixel_mm, 0.0))
        for mounting, pixel_mm in ((TRIAL_1, PIXEL_MM), (chain.sensor_from_image, chain.pixel_mm))
    )
    return TRIAL_1.rotation.inv().apply(after - before)


def test_what_is_predicted_is_what_a_thick_beam_does():
    seed, width_mm = 0, 3.0
    thin, thick = (
        calibrate_plane(
            scan_plane(np.random.default_rng(seed), beam_mm=w).lines, settings=PlaneFit(outlier_sigma=np.inf)
        )
        for w in (0.0, width_mm)
    )
    middle = thin.points.pixels.mean(axis=0)
    shift = moved_mm(thick.chain, middle)
    size = np.linalg.norm(shift)
    # From exact lines; and, as on real ones, from lines that the beam has already moved.
    for solution in (thin, thick):
        bias = predict_bias(solution, width_mm)
        np.testing.assert_allclose(bias.shift_mm, shift, atol=0.005 * size)
        assert bias.rms_mm == pytest.approx(thick.rms, rel=0.01)
        assert bias.width_mm == width_mm
    assert shift[1] < 0
    assert abs(shift[1]) > 0.99 * size
