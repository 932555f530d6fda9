"""The bias of a thick beam on a bare wall: closed form, and prediction against scans with such a beam."""

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, TRIAL_1, scan_plane

from calibration.beam import bias_along_beam_mm, predict_bias
from calibration.plane import calibrate_plane
from calibration.settings import PlaneFit


def tilted(angles_rad):
    """Normals of a wall in images that are tilted about their x axis."""
    zero = np.zeros_like(angles_rad)
    return np.column_stack([zero, -np.cos(angles_rad), np.sin(angles_rad)])


def of_uniform_tilt(reach):
    """Half the covariance of sine and cosine over the variance of the cosine, of tilts up to `reach`."""
    sine, cosine = (1 - np.cos(reach)) / reach, np.sin(reach) / reach
    product, square = np.sin(reach) ** 2 / (2 * reach), 0.5 + np.sin(2 * reach) / (4 * reach)
    return 0.5 * (product - sine * cosine) / (square - cosine**2)


def moved_mm(found, columns_and_rows):
    """Displacement of a pixel from where the true mounting has it, along the image's axes."""
    before, after = (
        mounting.apply(np.append(columns_and_rows * pixel_mm, 0.0))
        for mounting, pixel_mm in ((TRIAL_1, PIXEL_MM), (found.sensor_from_image, found.pixel_mm))
    )
    return TRIAL_1.rotation.inv().apply(after - before)


@pytest.mark.parametrize("width_mm", [0.6, 3.0])
def test_the_closed_form_is_the_integral_for_tilt_alone(width_mm):
    angles = np.deg2rad(np.linspace(-25, 25, 20001))
    assert of_uniform_tilt(np.deg2rad(25)) == pytest.approx(-2.11, abs=0.005)
    found = bias_along_beam_mm(tilted(angles), width_mm)
    # A sum over 20,001 angles differs from the integral by some 1e-4.
    assert found == pytest.approx(of_uniform_tilt(np.deg2rad(25)) * width_mm, rel=3e-4)


def test_what_is_predicted_is_what_a_thick_beam_does():
    seed, width_mm = 0, 3.0
    thin, thick = (
        calibrate_plane(
            scan_plane(np.random.default_rng(seed), beam_mm=w).lines, settings=PlaneFit(outlier_sigma=np.inf)
        )
        for w in (0.0, width_mm)
    )
    middle = thin.points.pixels.mean(axis=0)
    happened = moved_mm(thick.chain, middle)
    size = np.linalg.norm(happened)
    # From exact lines; and, as on real ones, from lines that the beam has already moved.
    for solution in (thin, thick):
        predicted = predict_bias(solution, width_mm)
        np.testing.assert_allclose(predicted.simulated_mm, happened, atol=0.005 * size)
        assert predicted.closed_form_mm == pytest.approx(happened[1], rel=0.05)
        assert predicted.rms_mm == pytest.approx(thick.rms, rel=0.01)
        assert predicted.width_mm == width_mm
    assert happened[1] < 0
    assert abs(happened[1]) > 0.99 * size
