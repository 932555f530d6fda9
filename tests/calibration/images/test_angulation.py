"""What a calibration error does where two sweeps meet, as published, and sweeps that cannot tell."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.angulation import PARAMETERS, angulation
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


@pytest.mark.parametrize("heading_deg", [0.0, 90.0], ids=["parallel", "crossing but not tilted"])
def test_sweeps_that_cannot_tell_are_refused_with_the_reason(heading_deg):
    first, second = fan(60, 0.0, 20.0, 0.0), fan(60, 0.0, 20.0, heading_deg)
    found = angulation(first, second, RigidTransform.identity(), CORNERS)
    assert found.verdict.startswith("insufficient")
    # A shift along the beam moves all points alike.
    assert found.alone[PARAMETERS.index("y")] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InsufficientDataError, match=found.weakest):
        found.require()
