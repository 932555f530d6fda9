"""What a calibration error does where two sweeps meet, as published, and sweeps that cannot tell."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.angulation import PARAMETERS, angulation, displacement_mm, translation_errors_mm
from speckle3d.core.errors import InsufficientDataError

CORNERS = np.array([[0.0, 0.0, 0.0], [38.0, 0.0, 0.0], [0.0, 44.0, 0.0], [38.0, 44.0, 0.0]])


def published_setup(alpha, u=40.0, v=20.0, d=100.0):
    """Figure 1 of Wein and Khamene: the point, the two sensor poses, the calibration; beta by equation 7."""
    beta = -np.arctan(-u / ((v - d) * np.cos(alpha)))
    first = RigidTransform.from_rotation(Rotation.from_rotvec([alpha, 0.0, 0.0]))
    turned = Rotation.from_rotvec([0.0, np.pi / 2, 0.0]) * Rotation.from_rotvec([beta, 0.0, 0.0])
    return (
        (u, v, 0.0),
        first,
        RigidTransform.from_rotation(turned),
        RigidTransform.from_translation([0.0, -d, 0.0]),
        beta,
    )


def fan(frames, degrees, length, heading_deg):
    """A sweep that tilts about the middle of its face; the sensor's axes are the image's."""
    share = np.linspace(-0.5, 0.5, frames)
    middle = np.array([19.0, 0.0, 0.0])
    heading = Rotation.from_rotvec([0.0, np.deg2rad(heading_deg), 0.0])
    tilts = Rotation.from_rotvec(np.outer(np.deg2rad(degrees) * share, [1.0, 0.0, 0.0]))
    shifts = np.outer(length * share, [0.0, 0.0, 1.0]) - tilts.apply(middle)
    return RigidTransform.from_rotation(heading) * RigidTransform.from_components(shifts, tilts)


@pytest.mark.parametrize("alpha_deg", [-30.0, -10.0, 20.0])
def test_shifts_disagree_as_published(alpha_deg):
    point, first, second, calibration, beta = published_setup(np.deg2rad(alpha_deg))
    # The construction is right if the second image shows the point.
    seen = (second * calibration).inv().apply((first * calibration).apply(point))
    assert seen[2] == pytest.approx(0.0, abs=1e-9)
    for axis in range(3):
        shift = 2.0 * np.eye(3)[axis]
        moved = displacement_mm(first, second, calibration, RigidTransform.from_translation(shift), point)
        expected = translation_errors_mm(shift, np.deg2rad(alpha_deg), beta)[axis]
        assert np.linalg.norm(moved) == pytest.approx(expected, rel=1e-9)


def test_any_shift_disagrees_as_equation_8_has_it():
    point, first, second, calibration, beta = published_setup(np.deg2rad(-30.0))
    alpha, (tx, ty, tz) = np.deg2rad(-30.0), (1.5, -0.7, 2.2)
    moved = displacement_mm(first, second, calibration, RigidTransform.from_translation([tx, ty, tz]), point)
    expected = [
        np.sin(beta) * ty + np.cos(beta) * tz - tx,
        np.cos(beta) * ty - np.sin(beta) * tz - np.cos(alpha) * ty + np.sin(alpha) * tz,
        -tx - np.sin(alpha) * ty - np.cos(alpha) * tz,
    ]
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_sensitivities_are_those_of_small_errors():
    first, second = fan(60, 40.0, 8.0, 0.0), fan(50, 30.0, 6.0, 90.0)
    found = angulation(first, second, RigidTransform.identity(), CORNERS)
    assert found.crossing_deg == pytest.approx(90.0, abs=1e-6)
    assert found.fan_deg == pytest.approx((40.0, 30.0), abs=1e-6)
    assert found.verdict == "sufficient"
    # x alone, whatever the fans: equation 9, but for the sweeps' turns within a fan (cos 20 degrees, 3 %).
    assert found.alone[PARAMETERS.index("x")] == pytest.approx(np.sqrt(2.0), rel=0.03)
    # y alone: equation 10 with the mean of cos cos over all tilts; those that meet are not quite all.
    mean = np.sin(np.deg2rad(20)) / np.deg2rad(20) * np.sin(np.deg2rad(15)) / np.deg2rad(15)
    assert found.alone[PARAMETERS.index("y")] == pytest.approx(np.sqrt(2 * (1 - mean)), rel=0.25)
    assert (found.recoverable <= found.alone + 1e-12).all()


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (fan(60, 0.0, 20.0, 0.0), fan(60, 0.0, 20.0, 0.0)),
        (fan(60, 0.0, 20.0, 0.0), fan(60, 0.0, 20.0, 90.0)),
    ],
    ids=["parallel", "crossing but not tilted"],
)
def test_sweeps_that_cannot_tell_are_refused_with_the_reason(first, second):
    found = angulation(first, second, RigidTransform.identity(), CORNERS)
    assert found.verdict.startswith("insufficient")
    with pytest.raises(InsufficientDataError, match=found.weakest):
        found.require()


def test_not_tilted_sweeps_leave_the_shift_along_the_beam_open():
    found = angulation(fan(60, 0.0, 20.0, 0.0), fan(60, 0.0, 20.0, 90.0), RigidTransform.identity(), CORNERS)
    assert found.alone[PARAMETERS.index("y")] == pytest.approx(0.0, abs=1e-9)
    assert found.weakest == "y"


def test_sweeps_that_a_bad_start_moves_apart_are_still_judged():
    first, second = fan(60, 40.0, 8.0, 0.0), fan(60, 40.0, 8.0, 90.0)
    start = RigidTransform.from_translation([300.0, 0.0, 0.0])
    found = angulation(first, second, start, CORNERS)
    assert max(found.overlap) == 0.0
    assert np.isfinite(found.recoverable).all()
