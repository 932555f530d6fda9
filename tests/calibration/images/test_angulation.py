"""What a calibration error does where two sweeps meet, as published, and sweeps that cannot tell."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.angulation import PARAMETERS, _disagreements, angulation
from speckle3d.core.errors import InsufficientDataError

CORNERS = np.array([[0.0, 0.0, 0.0], [38.0, 0.0, 0.0], [0.0, 44.0, 0.0], [38.0, 44.0, 0.0]])


def fan(frames, degrees, length, heading_deg):
    """A sweep that tilts about the middle of its face; the sensor's axes are the image's."""
    share = np.linspace(-0.5, 0.5, frames)
    middle = np.array([19.0, 0.0, 0.0])
    heading = Rotation.from_rotvec([0.0, np.deg2rad(heading_deg), 0.0])
    tilts = Rotation.from_rotvec(np.outer(np.deg2rad(degrees) * share, [1.0, 0.0, 0.0]))
    shifts = np.outer(length * share, [0.0, 0.0, 1.0]) - tilts.apply(middle)
    return RigidTransform.from_rotation(heading) * RigidTransform.from_components(shifts, tilts)


def displacement_mm(first, second, error, points):
    """How far apart a wrong calibration puts points that two images show: equation 5 of Wein and Khamene."""
    seen = (second.inv() * first).apply(points)
    return (second * error).apply(seen) - (first * error).apply(points)


def test_disagreements_are_the_derivative_of_equation_5():
    first, second = fan(3, 30.0, 8.0, 0.0), fan(5, 40.0, 8.0, 80.0)
    share, centre, h = (np.arange(9) + 0.5) / 9, CORNERS.mean(axis=0), 1e-6
    points = np.array([[38.0 * u, 44.0 * v, 0.0] for v in share for u in share])
    blocks = _disagreements(first, second, CORNERS)[0][81:162]  # of the middle image
    distance = np.stack([(each.inv() * first[1]).apply(points)[:, 2] for each in second])
    nearest = np.abs(distance).argmin(axis=0)
    for n in np.flatnonzero(np.isfinite(blocks).all(axis=(1, 2)))[::7]:
        for k, unit in enumerate(np.eye(6)):
            turn = Rotation.from_rotvec(h * unit[:3])
            error = RigidTransform.from_components(centre + h * unit[3:] - turn.apply(centre), turn)
            moved = displacement_mm(first[1], second[int(nearest[n])], error, points[n])
            np.testing.assert_allclose(blocks[n][:, k], moved / h, atol=1e-4)


@pytest.mark.parametrize("heading_deg", [0.0, 90.0], ids=["parallel", "crossing but not tilted"])
def test_sweeps_that_cannot_tell_are_refused_with_the_reason(heading_deg):
    first, second = fan(60, 0.0, 20.0, 0.0), fan(60, 0.0, 20.0, heading_deg)
    found = angulation(first, second, RigidTransform.identity(), CORNERS)
    assert found.verdict.startswith("insufficient")
    # A shift along the beam moves all points alike.
    assert found.alone[PARAMETERS.index("y")] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InsufficientDataError, match=found.weakest):
        found.require()
