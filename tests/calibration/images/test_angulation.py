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


def translation_errors(alpha, beta):
    """Equations 9 to 11: disagreement per shift along x, y, z of perpendicular fans at two tilts."""
    cosines, sines = np.cos(alpha) * np.cos(beta), np.sin(alpha) * np.sin(beta)
    return np.sqrt(2.0 * np.array([1.0, 1.0 - cosines, 1.0 - sines]))


@pytest.mark.parametrize("alpha_deg", [-30.0, 20.0])
def test_disagreements_of_perpendicular_fans_are_as_published(alpha_deg):
    first, second = fan(2, 0.0, 0.0, 0.0), fan(41, 40.0, 0.0, 90.0)
    tilt = Rotation.from_rotvec([np.deg2rad(alpha_deg), 0.0, 0.0])
    first = first * RigidTransform.from_rotation(tilt)
    blocks, _ = _disagreements(first, second, CORNERS)
    passed = np.isfinite(blocks).all(axis=(1, 2))
    assert passed.sum() > 10
    betas = np.deg2rad(40.0 * np.linspace(-0.5, 0.5, 41))
    possible = np.array([translation_errors(np.deg2rad(alpha_deg), beta) for beta in betas])
    for block in blocks[passed]:
        told = np.linalg.norm(block[:, 3:], axis=0)
        assert np.abs(possible - told).max(axis=1).min() < 1e-9


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
