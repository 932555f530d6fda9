"""Whether the motion was sufficient: what is said, and that the motion asked for does cure the refusal."""

import numpy as np
import pytest
from calibration_examples import BEAM_DOWN, COLUMNS, PIXEL_MM, TRIAL_1, about, centre_of
from scipy.spatial.transform import RigidTransform

from calibration.motion import MOTIONS
from calibration.orientation import calibrate_orientation
from calibration.plane import calibrate_plane
from calibration.points import ImagePoints
from speckle3d.core.errors import InsufficientDataError

FULL = {"tilt": 25.0, "roll": 15.0, "rotate": 25.0, "move": 11.0}
"""What a hand does when told to: degrees, or mm, to both sides. Named by the first word of the advice."""


def lines_of(moves, count=200, noise_mm=0.1):
    """Lines of a floor, from a probe that turns about a point of it, 23 mm deep unless moved up and down."""
    rng, middle_mm = np.random.default_rng(0), (COLUMNS - 1) / 2 * PIXEL_MM[0]

    def turn_about(word, axis):
        return about(axis, np.deg2rad(moves.get(word, 0.0)) * rng.uniform(-1, 1, count))

    turn = BEAM_DOWN * turn_about("roll", 2) * turn_about("tilt", 0) * turn_about("rotate", 1)
    depth = 23.0 + moves.get("move", 0.0) * rng.uniform(-1, 1, count)
    up = turn.inv().apply([0.0, 0.0, 1.0])
    height = -(up[:, 0] * middle_mm + up[:, 1] * depth)
    place = np.column_stack([rng.uniform(-100, 100, (count, 2)), height])
    ends = np.array([0.0, COLUMNS - 1.0])
    rows = -(height[:, None] + up[:, :1] * ends * PIXEL_MM[0]) / up[:, 1:2]
    rows += noise_mm * rng.standard_normal(rows.shape)
    pixels = np.stack([np.broadcast_to(ends, rows.shape), rows / PIXEL_MM[1]], axis=-1)
    poses = RigidTransform.from_components(place, turn) * TRIAL_1.inv()
    return ImagePoints.of_lines(np.arange(count), pixels, poses)


def calibrate_lines(moves):
    return calibrate_plane(lines_of(moves))


def calibrate_directions(moves):
    return calibrate_orientation(lines_of(moves, 100), PIXEL_MM)


def advice(text):
    return [motion.split()[0] for motion in MOTIONS if motion in text]


@pytest.mark.parametrize(
    ("calibrate", "motions"),
    [
        (calibrate_lines, ("tilt", "move")),
        (calibrate_directions, ("roll", "rotate")),
    ],
)
def test_doing_as_told_cures_a_calibration(calibrate, motions):
    moves = {word: FULL[word] for word in motions}
    with pytest.raises(InsufficientDataError) as error:
        calibrate(moves)
    new = [word for word in advice(str(error.value)) if word not in moves]
    assert new
    solution = calibrate(moves | {word: FULL[word] for word in new})
    chain, error = solution.chain, solution.adequacy.standard_error
    # Four times the standard error: of the worst corner, or about the worst axis.
    if solution.angular:
        assert (TRIAL_1.rotation.inv() * chain.sensor_from_image.rotation).magnitude() < 4 * error
    else:
        away = centre_of(chain.sensor_from_image, chain.pixel_mm) - centre_of(TRIAL_1, PIXEL_MM)
        assert np.linalg.norm(away) < 4 * error
