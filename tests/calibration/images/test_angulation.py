"""What a calibration error does where two sweeps meet, as published, and sweeps that cannot tell."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.angulation import angulation
from speckle3d.core.errors import InsufficientDataError


def fan(frames, degrees, length, heading_deg):
    """A sweep that tilts about the middle of its face; the sensor's axes are the image's."""
    share = np.linspace(-0.5, 0.5, frames)
    middle = np.array([19.0, 0.0, 0.0])
    heading = Rotation.from_rotvec([0.0, np.deg2rad(heading_deg), 0.0])
    tilts = Rotation.from_rotvec(np.outer(np.deg2rad(degrees) * share, [1.0, 0.0, 0.0]))
    shifts = np.outer(length * share, [0.0, 0.0, 1.0]) - tilts.apply(middle)
    return RigidTransform.from_rotation(heading) * RigidTransform.from_components(shifts, tilts)


@pytest.mark.parametrize(
    ("degrees", "heading_deg", "word"),
    [(40.0, 5.0, "cross"), (15.0, 90.0, "fan"), (25.0, 60.0, "weak"), (40.0, 90.0, "sufficient")],
)
def test_sweeps_that_hardly_cross_or_fan_are_refused_with_the_advice(degrees, heading_deg, word):
    first, second = fan(60, degrees, 20.0, 0.0), fan(60, degrees, 20.0, heading_deg)
    angles = angulation(first, second, RigidTransform.identity())
    assert angles.crossing_deg == pytest.approx(heading_deg, abs=1e-6)
    assert angles.fan_deg == pytest.approx((degrees, degrees))
    assert word in angles.verdict
    if word in ("cross", "fan"):
        with pytest.raises(InsufficientDataError, match=f"degrees; {word}[^;]*$"):
            angles.require()
    else:
        angles.require()
