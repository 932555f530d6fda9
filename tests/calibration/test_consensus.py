"""Consensus among candidates: half or more of them wrong, several to a frame, and nothing but chance."""

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, scan_wires

from calibration.consensus import find_consensus
from calibration.points import ImagePoints
from calibration.wires import calibrate_cross_wire
from speckle3d.core.errors import InsufficientDataError

CROSSING_MM = np.array([10.0, -20.0, 30.0])


def scan(seed, count=52, noise_mm=0.4):
    rng = np.random.default_rng(seed)
    pixels, readings = scan_wires(rng, np.tile(CROSSING_MM, (count, 1)), noise_mm=noise_mm)
    return ImagePoints(pixels, np.arange(count), readings)


def anywhere(rng, points, count):
    """Picks that show nothing, over the range of those that do."""
    return rng.uniform(points.pixels.min(axis=0), points.pixels.max(axis=0), (count, 2))


def test_one_right_candidate_of_six_in_two_thirds_of_the_frames():
    points, rng = scan(2), np.random.default_rng(3)
    pixels = np.stack([anywhere(rng, points, 52) for _ in range(6)], axis=1)
    lacking = rng.permutation(52) < 16
    place = np.minimum(rng.geometric(0.5, 52) - 1, 5)
    true = place[~lacking] + 6 * np.flatnonzero(~lacking)
    pixels.reshape(-1, 2)[true] = points.pixels[~lacking]
    frame = np.repeat(np.arange(52), 6)
    candidates = ImagePoints(pixels.reshape(-1, 2), frame, points.world_from_sensor[frame])
    solution = calibrate_cross_wire(candidates, PIXEL_MM)
    assert len(solution.points) == 52
    np.testing.assert_array_equal(solution.points.frame, np.arange(52))
    crossings = solution.points.pixels[solution.used & ~lacking]
    np.testing.assert_array_equal(crossings, points.pixels[solution.used & ~lacking])
    assert (solution.used & ~lacking).sum() >= 0.9 * (~lacking).sum()
    # A wrong candidate may be near by chance: one in thirty is within 4 mm.
    assert (solution.used & lacking).sum() <= 2
    assert solution.rms < 0.6


@pytest.mark.parametrize(("frames", "per_frame"), [(8, 1), (30, 6)])
def test_chance_candidates(frames, per_frame):
    points, rng = scan(4, frames), np.random.default_rng(5)
    frame = np.repeat(np.arange(frames), per_frame)
    pixels = anywhere(rng, points, frames * per_frame)
    chance = ImagePoints(pixels, frame, points.world_from_sensor[frame])
    assert not find_consensus(chance, PIXEL_MM).is_significant
    with pytest.raises(InsufficientDataError):
        calibrate_cross_wire(chance, PIXEL_MM)
