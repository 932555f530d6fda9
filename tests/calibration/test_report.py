"""What is saved of a solution: parameters with standard errors, frames, units; and what its report shows."""

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, scan_plane
from scipy.spatial.transform import Rotation

from calibration.plane import calibrate_plane
from calibration.report import as_calibration
from calibration.settings import PlaneFit
from speckle3d.core.calibration import FramesUsed

ALL = FramesUsed(300, ())


def of_plane(seed=0, count=150, noise_mm=0.2, **options):
    scan = scan_plane(np.random.default_rng([seed, 8]), count, line_noise_mm=noise_mm)
    return calibrate_plane(scan.lines, PIXEL_MM, PlaneFit(**options))


def test_values_are_those_of_the_pose_and_in_the_units_that_they_name():
    found = as_calibration(of_plane(), "plane", ALL, time_offset_s=0.08)
    named = {one.name: one for one in found.parameters}
    units = {name: named[name].unit for name in named}
    assert units == {
        name: "mm/pixel" if name[:2] == "s_" else "mm" if name[0] in "xyz" else "rad" for name in named
    }
    place = [named[name].value for name in "xyz"]
    np.testing.assert_allclose(found.translation_mm, place)
    angles = [named[name].value for name in ("alpha", "beta", "gamma")]
    again = Rotation.from_euler("ZYX", angles)
    np.testing.assert_allclose(found.rotation.as_matrix(), again.as_matrix(), atol=1e-12)
    assert found.pixel_mm[0] == named["s_x"].value
    assert (found.sensor, found.rms_unit, found.time_offset_s) == ("tracker", "mm", 0.08)
    # Noise of 0.2 mm along the beam, as a height.
    assert found.rms == pytest.approx(0.2 * 0.96, rel=0.1)
    # One quantity, one error: roll, yaw and tilt stand once in the table.
    angles = [row for row in found.rows() if row[0].startswith(("roll", "yaw", "tilt", "alpha"))]
    errors = np.rad2deg(np.sqrt(np.diag(found.covariance)[2::-1]))
    halves = [float(row[1].split("+- ")[1].removesuffix(" (95 %)")) for row in angles]
    assert halves == pytest.approx(1.96 * errors, abs=6e-4)
