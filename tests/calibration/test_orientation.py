"""Calibration of an orientation sensor: precision, gravity and the mirror, refusals."""

import numpy as np
import pytest
from calibration_examples import line_directions
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.orientation import calibrate_orientation
from calibration.points import ImagePoints
from calibration.settings import OrientationFit
from speckle3d.core.errors import InsufficientDataError

SQUARE = np.ones(2)

LINE_NOISE_DEG = 0.15
"""Of a line 30 mm long with 30 independent edges found to 0.1 mm: 0.1 / 30 * sqrt(12 / 30) rad, 0.12 deg."""


def tilt_yaw_roll_deg(solution, mounting):
    return np.rad2deg((mounting.inv() * solution.chain.sensor_from_image.rotation).as_rotvec())


def calibrate(directions, readings, **options):
    lines = ImagePoints(directions, np.arange(len(directions)), RigidTransform.from_rotation(readings))
    return calibrate_orientation(lines, SQUARE, OrientationFit(**options))


@pytest.mark.slow
@pytest.mark.parametrize("level", [True, False])
def test_twenty_five_remounted_calibrations_are_as_precise_as_they_must_be(level):
    # Housden 2008, Table 1: 0.08, 1.10 and 1.50 degrees in roll, yaw and tilt.
    errors = []
    for trial in range(25):
        rng = np.random.default_rng([trial, 2008])
        directions, readings, mounting = line_directions(
            rng, 100, noise_deg=LINE_NOISE_DEG, sensor_noise_deg=0.1, heading_deg=rng.normal(0, 5)
        )
        errors.append(tilt_yaw_roll_deg(calibrate(directions, readings, level=level), mounting))
    tilt, yaw, roll = np.std(errors, axis=0, ddof=1)
    assert tilt <= 0.8
    assert yaw <= 0.6
    # A plane whose slope is not known costs roll: the bound below is 0.26 degrees.
    assert roll <= (0.08 if level else 0.35)


@pytest.mark.parametrize(
    "trials", [range(6), pytest.param(range(6, 90), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_the_mirror_is_never_wrong(trials):
    for trial in trials:
        rng = np.random.default_rng([trial, 1])
        directions, readings, mounting = line_directions(
            rng, 30, noise_deg=rng.uniform(0, 0.3), tilt_deg=30.0, roll_deg=25.0, from_below=bool(trial % 2)
        )
        side = "below" if trial % 2 else "above"
        solution = calibrate(directions, readings, level=bool(trial % 3), viewed_from=side)
        assert np.linalg.norm(tilt_yaw_roll_deg(solution, mounting)) < 20.0, trial


def test_errors_of_the_mirror_are_about_its_own_axes():
    directions, readings, _ = line_directions(np.random.default_rng(3), 30, noise_deg=0.1)
    above, below = (
        calibrate(directions, readings, viewed_from=side).image_covariance(("gamma", "beta", "alpha"))
        for side in ("above", "below")
    )
    signs = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(below, signs @ above @ signs, rtol=1e-6)


def test_beams_that_are_level_on_average_cannot_be_told_from_their_mirror():
    rng = np.random.default_rng(0)
    above = line_directions(rng, 60, noise_deg=0.05, mounting=Rotation.identity())
    below = line_directions(rng, 60, noise_deg=0.05, mounting=Rotation.identity(), from_below=True)
    directions = np.concatenate([above[0], below[0]])
    readings = Rotation.concatenate([above[1], below[1]])
    with pytest.raises(InsufficientDataError, match="mirror"):
        calibrate(directions, readings, level=True)
