"""What is saved of a solution: parameters with standard errors, frames, units; and what its report shows."""

import re

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, line_directions, scan_plane
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.orientation import calibrate_orientation
from calibration.plane import calibrate_plane
from calibration.points import ImagePoints
from calibration.report import as_calibration
from calibration.settings import PlaneFit
from speckle3d.core.calibration import FramesUsed

FRAMES = FramesUsed(300, ())


def of_plane(seed=0, count=150, noise_mm=0.2, **options):
    scan = scan_plane(np.random.default_rng([seed, 8]), count, line_noise_mm=noise_mm)
    return calibrate_plane(scan.lines, PIXEL_MM, PlaneFit(**options))


def test_values_are_those_of_the_pose_and_in_the_units_that_they_name():
    calibration = as_calibration(of_plane(), "plane", FRAMES, time_offset_s=0.08)
    parameters = {parameter.name: parameter for parameter in calibration.parameters}
    units = {name: parameters[name].unit for name in parameters}
    assert units == {
        name: "mm/pixel" if name[:2] == "s_" else "mm" if name[0] in "xyz" else "rad" for name in parameters
    }
    place = [parameters[name].value for name in "xyz"]
    np.testing.assert_allclose(calibration.translation_mm, place)
    angles = [parameters[name].value for name in ("alpha", "beta", "gamma")]
    again = Rotation.from_euler("ZYX", angles)
    np.testing.assert_allclose(calibration.rotation.as_matrix(), again.as_matrix(), atol=1e-12)
    assert calibration.pixel_mm[0] == parameters["s_x"].value
    assert (calibration.sensor, calibration.rms_unit, calibration.time_offset_s) == ("tracker", "mm", 0.08)
    # Noise of 0.2 mm along the beam, as a height.
    assert calibration.rms == pytest.approx(0.2 * 0.96, rel=0.1)
    # One quantity, one error: roll, yaw and tilt stand once in the table.
    angles = [row for row in calibration.rows() if row[0].startswith(("roll", "yaw", "tilt", "alpha"))]
    errors = np.rad2deg(np.sqrt(np.diag(calibration.covariance)[2::-1]))
    halves = [float(row[1].split("+- ")[1].removesuffix(" (95 %)")) for row in angles]
    assert halves == pytest.approx(1.96 * errors, abs=6e-4)


def test_a_weak_verdict_names_what_is_known_least_with_its_interval():
    directions, readings, _ = line_directions(np.random.default_rng(1), 60, tilt_deg=8.0)
    lines = ImagePoints(directions, np.arange(60), RigidTransform.from_rotation(readings))
    solution = calibrate_orientation(lines, np.ones(2))
    deviations = np.sqrt(np.diag(solution.image_covariance(("gamma", "beta", "alpha"))))
    words = re.search(r"Least certain is (\w+), \+- (\S+) deg", solution.adequacy.verdict)
    name, half = words.groups()
    assert name == ("tilt", "yaw", "roll")[int(np.argmax(deviations))]
    assert float(half) == pytest.approx(np.rad2deg(1.96 * deviations.max()), rel=0.1)
