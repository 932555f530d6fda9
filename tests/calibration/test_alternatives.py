"""Discrete ambiguities and the pixel size given: what near ties and constant depth lead to."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, TRIAL_1, scan_plane

from calibration.alternatives import best_solution, half_turns, together
from calibration.chain import POSE
from calibration.motions import UP_AND_DOWN
from calibration.plane import Plane, calibrate_plane
from speckle3d.core.errors import InsufficientDataError, InvalidInputError


def lines(depth_mm=(12.0, 34.0), count=100, noise_mm=0.1):
    return scan_plane(np.random.default_rng(0), count, depth_mm=depth_mm, line_noise_mm=noise_mm).lines


def degrees_off(solution):
    turn = TRIAL_1.rotation.inv() * solution.chain.sensor_from_image.rotation
    return np.rad2deg(turn.magnitude())


@pytest.mark.parametrize("fit_pixels", [True, False])
def test_lines_at_one_depth_do_not_tell_the_image_from_its_mirror(fit_pixels):
    with pytest.raises(InsufficientDataError) as refused:
        calibrate_plane(lines((23.0, 23.0)), PIXEL_MM, fit_pixels)
    assert str(refused.value).endswith(UP_AND_DOWN.advice)


@pytest.mark.slow
def test_the_answer_does_not_hang_on_which_alternative_is_the_start():
    seen = lines()
    truth = calibrate_plane(seen, PIXEL_MM, fit_pixels=False)
    for start in half_turns(truth.chain, seen, Plane()):
        assert degrees_off(best_solution(seen, Plane(), [start], POSE)) < 1.0


def test_a_pixel_size_given_holds_where_the_lines_say_little():
    # Depths from 20 to 26 mm; the given size is 1 % off, and so is the image's far corner, by 0.5 mm.
    solution = calibrate_plane(lines((20.0, 26.0), 200), 1.01 * PIXEL_MM)
    np.testing.assert_allclose(solution.chain.pixel_mm, PIXEL_MM, rtol=0.03)
    assert degrees_off(solution) < 2.0


@pytest.mark.slow
def test_lines_that_contradict_the_pixel_size_are_believed_if_they_determine_it():
    solution = calibrate_plane(lines(), 1.3 * PIXEL_MM)
    # Determined to 0.2 % by 100 lines.
    np.testing.assert_allclose(solution.chain.pixel_mm, PIXEL_MM, rtol=0.01)


def test_a_pixel_error_that_is_not_positive_is_refused():
    with pytest.raises(InvalidInputError, match="pixel_error"):
        calibrate_plane(lines(), PIXEL_MM, pixel_error=0.0)


def test_how_many_residuals_count_as_one():
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(500), 2)
    white = rng.standard_normal((1000, 1))
    # Standard deviation 0.15 for 500 frames.
    assert together(white, frame) < 1.4
    # Both points of a frame alike, ten frames alike: twenty.
    slow = np.repeat(rng.standard_normal(50), 20)[:, None]
    assert together(slow, frame) == pytest.approx(20.0, rel=0.5)


def test_half_turns_leave_the_middle_where_it_is():
    seen = lines()
    chain = replace(calibrate_plane(seen, PIXEL_MM).chain, sensor_from_image=TRIAL_1)
    middle = np.append(np.median(seen.pixels, axis=0) * chain.pixel_mm, 0.0)
    for turned in half_turns(chain, seen, Plane()):
        step = TRIAL_1.inv() * turned.sensor_from_image
        np.testing.assert_allclose(step.apply(middle), middle, atol=1e-9)
        assert step.rotation.magnitude() == pytest.approx(np.pi)
