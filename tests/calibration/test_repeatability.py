"""Scatter of repeated calibrations, computed by hand; errors on recordings not calibrated with."""

import numpy as np
import pytest
from calibration_examples import scan_plane
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.plane import calibrate_plane
from calibration.repeatability import repeatability, validate
from speckle3d.core.calibration import Calibration, FramesUsed

SIZE_PX = (101, 201)
PITCH_MM = np.array([0.4, 0.2])
"""So that the image is 40 mm square."""


def calibration(shift_mm):
    return Calibration(
        method="plane",
        sensor="tracker",
        rotation=Rotation.identity(),
        translation_mm=np.array(shift_mm),
        pixel_mm=PITCH_MM,
        covariance=np.eye(6),
        parameters=(),
        rms=0.1,
        rms_unit="mm",
        condition_number=10.0,
        frames=FramesUsed(1, (0,)),
    )


def rms(residuals):
    return np.sqrt(np.mean(residuals**2))


def test_shifts_are_counted_from_the_first_trial():
    places = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 0.0)]
    scatter = repeatability([calibration(place) for place in places], SIZE_PX)
    assert scatter.trials == 4
    np.testing.assert_allclose(scatter.roll_yaw_tilt_sd_rad, 0.0, atol=1e-12)
    np.testing.assert_allclose(scatter.centre_shift_mm, [1.0, 2.0, 0.0])
    # Along x .25 * 3 and .75, along y .5 * 3 and 1.5 from the mean: squares sum to 0.75 and 3.
    assert scatter.centre_sd_mm == pytest.approx(np.sqrt(3.75 / 3))
    assert scatter.corner_sd_mm == pytest.approx(scatter.centre_sd_mm)


def test_another_recording_of_a_plane_may_be_of_another_plane():
    solution = calibrate_plane(scan_plane(np.random.default_rng(0), 300, line_noise_mm=0.2).lines)
    wall = RigidTransform.from_components([50.0, -300.0, 80.0], Rotation.from_euler("x", 70, degrees=True))
    second = scan_plane(np.random.default_rng(1), 200, line_noise_mm=0.2, floor=wall).lines
    residuals = validate(solution, second)
    # Noise of 0.2 mm along the beam, times its cosine with the wall's normal: 0.97 for such tilts and rolls.
    assert rms(residuals) == pytest.approx(0.2 * 0.96, rel=0.10)
