"""What is saved of a solution: parameters with standard errors, frames, units; and what its report shows."""

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, TRIAL_1, scan_plane, scan_wires
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.plane import calibrate_plane
from calibration.points import PROBE, ImagePoints
from calibration.report import as_calibration, rows_of
from calibration.settings import PlaneFit, WireFit
from calibration.wires import calibrate_cross_wire
from speckle3d.core.calibration import FramesUsed

ALL = FramesUsed(300, ())
TRUTH = dict(zip(PROBE, [*PIXEL_MM, *TRIAL_1.translation, *np.deg2rad([-0.55, 44.22, -90.37])], strict=True))
"""TR 303's Table 3: alpha, beta and gamma as printed."""


def of_plane(seed=0, count=150, noise_mm=0.2, **options):
    scan = scan_plane(np.random.default_rng([seed, 8]), count, line_noise_mm=noise_mm)
    return calibrate_plane(scan.lines, PIXEL_MM, PlaneFit(**options))


def of_crossing(seed=0, count=80, noise_mm=0.3):
    rng = np.random.default_rng([seed, 9])
    pixels, readings = scan_wires(rng, np.tile([10.0, -20.0, 30.0], (count, 1)), noise_mm=noise_mm)
    shift, turn = readings.as_components()
    shift = shift + 0.5 * rng.standard_normal(shift.shape)
    return calibrate_cross_wire(
        ImagePoints(pixels, np.arange(count), RigidTransform.from_components(shift, turn)),
        settings=WireFit(beside_mm=0.0),
    )


@pytest.mark.parametrize(("solve", "trials"), [(of_plane, 30), (of_crossing, 50)])
@pytest.mark.slow
def test_standard_errors_of_the_published_parameters_are_those_of_repetition(solve, trials):
    found = [as_calibration(solve(seed), "plane", ALL) for seed in range(trials)]
    names = [one.name for one in found[0].parameters if one.name in PROBE]
    assert tuple(names) == PROBE
    parameters = [{one.name: one for one in each.parameters} for each in found]
    values = np.array([[each[name].value - TRUTH[name] for name in names] for each in parameters])
    # Errors of roll, yaw and tilt are about the image's axes z, y and x.
    turned = [(TRIAL_1.inv() * each.sensor_from_image).rotation.as_rotvec()[::-1] for each in found]
    values[:, names.index("alpha") : names.index("gamma") + 1] = turned
    claims = np.array([[each[name].standard_error for name in names] for each in parameters])
    scores = values / claims
    # A standard deviation is known to 1 / sqrt(2 n), a mean to 1 / sqrt(n): three times either.
    np.testing.assert_allclose(np.std(scores, axis=0), 1.0, atol=3 / np.sqrt(2 * trials))
    # Residuals in mm shrink with the pixels: least squares, as published, prefers smaller ones, by half
    # a standard error here; what of it is left moves the others by a tenth.
    few = np.where(np.char.startswith(names, "s_"), 0.7, 0.1)
    assert (np.abs(np.mean(scores, axis=0)) < few + 3 / np.sqrt(trials)).all()


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
    told = [row for row in rows_of(found) if row[0].startswith(("roll", "yaw", "tilt", "alpha"))]
    errors = np.rad2deg(np.sqrt(np.diag(found.covariance)[2::-1]))
    halves = [float(row[1].split("+- ")[1].removesuffix(" (95 %)")) for row in told]
    assert halves == pytest.approx(1.96 * errors, abs=6e-4)


def test_every_frame_is_used_or_has_a_reason():
    scan = scan_plane(np.random.default_rng(0), 100, line_noise_mm=0.2)
    # Frames 0 to 9 show nothing; 10 to 14 have no reading; 20, 33 and 57 show another line.
    numbers = np.concatenate([np.arange(15, 100)])
    shown = np.repeat(np.isin(np.arange(100), numbers), 2)
    pixels = scan.lines.pixels.copy()
    for wrong in (20, 33, 57):
        pixels[2 * wrong : 2 * wrong + 2, 1] += 60.0
    lines = ImagePoints(pixels, scan.lines.frame, scan.lines.world_from_sensor)[shown]
    before = dict.fromkeys(range(10), "no line found") | dict.fromkeys(range(10, 15), "no sensor reading")
    found = as_calibration(calibrate_plane(lines), "plane", FramesUsed(100, (), before)).frames
    assert found.given == 100
    assert set(found.used) | set(found.dropped) == set(range(100))
    assert not set(found.used) & set(found.dropped)
    assert list(found.used) == sorted(found.used)
    assert all(type(number) is int for number in (*found.used, *found.dropped))
    assert {n: found.dropped[n] for n in before} == before
    assert set(found.dropped) - set(before) == {20, 33, 57}
    # 60 rows are 8.3 mm along the beam, and less as a height.
    millimetres = [float(found.dropped[n].split()[-2]) for n in (20, 33, 57)]
    assert all(7.0 < size < 9.0 for size in millimetres)
    assert all(found.dropped[n].endswith(" mm") for n in (20, 33, 57))
