"""Whether the motion was sufficient: what is said, and that the motion asked for does cure the refusal."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_examples import BEAM_DOWN, COLUMNS, PIXEL_MM, TRIAL_1, about, scan_wires
from scipy.spatial.transform import RigidTransform

from calibration.chain import ImagePoints
from calibration.identifiability import REFUSED_MM, WEAK_MM, judge, require_adequate
from calibration.motions import MOTIONS
from calibration.orientation import calibrate_orientation
from calibration.plane import Plane, calibrate_plane
from calibration.solver import solve_chain
from calibration.wires import calibrate_cross_wire
from speckle3d.core.errors import InsufficientDataError

FULL = {"tilt": 25.0, "roll": 15.0, "rotate": 25.0, "move": 11.0, "shift": 15.0}
"""What a hand does when told to: degrees, or mm, to both sides. Named by the first word of the advice."""

CENTRE_MM = (COLUMNS - 1) / 2 * PIXEL_MM[0]
SOME = tuple(word for word in FULL if word != "shift")


def lines_of(moves, seed=0, count=200, noise_mm=0.1):
    """Lines of a floor, from a probe that turns about a point of it, 23 mm deep unless moved up and down."""
    rng = np.random.default_rng(seed)

    def turned(word, axis):
        return about(axis, np.deg2rad(moves.get(word, 0.0)) * rng.uniform(-1, 1, count))

    turn = BEAM_DOWN * turned("roll", 2) * turned("tilt", 0) * turned("rotate", 1)
    depth = 23.0 + moves.get("move", 0.0) * rng.uniform(-1, 1, count)
    up = turn.inv().apply([0.0, 0.0, 1.0])
    height = -(up[:, 0] * CENTRE_MM + up[:, 1] * depth)
    place = RigidTransform.from_components(
        np.column_stack([rng.uniform(-100, 100, (count, 2)), height]), turn
    )
    ends = np.array([0.0, COLUMNS - 1.0])
    rows = -(height[:, None] + up[:, :1] * ends * PIXEL_MM[0]) / up[:, 1:2]
    rows += noise_mm * rng.standard_normal(rows.shape)
    pixels = np.stack([np.broadcast_to(ends, rows.shape), rows / PIXEL_MM[1]], axis=-1)
    return ImagePoints.of_lines(np.arange(count), pixels, place * TRIAL_1.inv())


def calibrate_lines(moves):
    return calibrate_plane(lines_of(moves))


def calibrate_directions(moves, level):
    lines = lines_of(moves, count=100)
    along = lines.pixels[1::2] - lines.pixels[::2]
    turns = lines.world_from_sensor.rotation[::2]
    return calibrate_orientation(along, np.arange(len(along)), turns, PIXEL_MM, level=level)


def calibrate_dots(moves):
    named = {"tilt_deg": "tilt", "roll_deg": "roll", "yaw_deg": "rotate"}
    degrees = {name: moves.get(word, 0.0) for name, word in named.items()}
    pixels, readings = scan_wires(np.random.default_rng(0), np.zeros((60, 3)), noise_mm=0.3, **degrees)
    return calibrate_cross_wire(ImagePoints(pixels, np.arange(60), readings))


def advised(text):
    return [motion.advice.split()[0] for motion in MOTIONS if motion.advice in text]


def cured(calibrate, moves, rounds):
    """Do as told until the calibration is accepted; how many times that took."""
    moves = dict(moves)
    for told in range(rounds + 1):
        try:
            return told, calibrate(moves)
        except InsufficientDataError as refusal:
            new = [word for word in advised(str(refusal)) if word not in moves]
            if not new:
                raise AssertionError(f"told to do what was done: {sorted(moves)}") from refusal
            moves |= {word: FULL[word] for word in new}
    raise AssertionError(f"still refused after {rounds} rounds of advice")


def centre_error_mm(solution):
    chain = solution.chain
    pixel = np.array([COLUMNS / 2, COLUMNS / 2])
    found = chain.sensor_from_image.apply(np.append(pixel * chain.pixel_mm, 0.0))
    return np.linalg.norm(found - TRIAL_1.apply(np.append(pixel * PIXEL_MM, 0.0)))


@pytest.mark.parametrize("done", [tuple(w for k, w in enumerate(SOME) if n >> k & 1) for n in (2, 9)])
def test_doing_as_told_cures_a_plane_calibration(done):
    moves = {word: FULL[word] for word in done}
    told, solution = cured(calibrate_lines, moves, rounds=2)
    assert judge(solution).missing == ()
    # The standard error is 0.2 to 0.65 mm; four times that.
    assert centre_error_mm(solution) < 4 * judge(solution).standard_error
    assert told <= 4 - len(done)


@pytest.mark.parametrize("level", [True, False])
@pytest.mark.parametrize("done", [("tilt",), ("tilt", "roll"), ("roll", "rotate")])
def test_doing_as_told_cures_an_orientation_calibration(done, level):
    solution = cured(
        lambda moves: calibrate_directions(moves, level), {word: FULL[word] for word in done}, rounds=2
    )[1]
    error = (TRIAL_1.rotation.inv() * solution.chain.sensor_from_image.rotation).magnitude()
    # Three components; four times the worst one's standard error.
    assert error < 4 * judge(solution).standard_error


@pytest.mark.parametrize("done", [(), ("tilt",), ("roll",), ("rotate",)])
def test_doing_as_told_cures_a_crossing(done):
    solution = cured(calibrate_dots, {word: FULL[word] for word in done}, rounds=1)[1]
    assert centre_error_mm(solution) < 4 * judge(solution).standard_error


def test_the_first_advice_is_the_motion_that_is_missing():
    for word in ("move",):
        moves = {one: FULL[one] for one in SOME if one != word}
        with pytest.raises(InsufficientDataError) as refusal:
            calibrate_lines(moves)
        assert advised(str(refusal.value)) == [word]
    with pytest.raises(InsufficientDataError) as refusal:
        calibrate_directions({"roll": 15.0, "rotate": 25.0}, level=True)
    assert advised(str(refusal.value)) == ["tilt"]


def test_pixels_that_shrink_to_nothing_are_refused():
    # About a point at one depth any probe that is one point big hovers at one height: no residual at all.
    with pytest.raises(InsufficientDataError, match="up and down"):
        calibrate_lines({"tilt": 25.0, "roll": 15.0, "rotate": 25.0})


@pytest.mark.slow
def test_three_words_for_three_states():
    moves = {"roll": 15.0, "move": 11.0}
    good, weak = lines_of(moves | {"tilt": 25.0}), lines_of(moves | {"tilt": 8.0}, noise_mm=0.4)
    sufficient, weakly = judge(calibrate_plane(good)), judge(calibrate_plane(weak))
    assert not sufficient.refused
    assert sufficient.missing == ()
    assert sufficient.standard_error < WEAK_MM
    assert f"{sufficient.standard_error:.2g} mm" in sufficient.verdict
    assert f"{sufficient.condition_number:.3g}" in sufficient.verdict
    assert not weakly.refused
    assert WEAK_MM < weakly.standard_error < REFUSED_MM
    assert weakly.verdict.endswith(MOTIONS[0].advice)
    assert f"{weakly.standard_error:.2g} mm" in weakly.verdict
    assert weakly.missing == (MOTIONS[0].advice,)


@pytest.mark.slow
def test_exact_lines_do_not_make_any_motion_sufficient():
    lines = lines_of({"tilt": 0.3, "roll": 0.3, "move": 11.0}, noise_mm=0.0)
    with pytest.raises(InsufficientDataError, match="tilt"):
        calibrate_plane(lines)


def test_angles_are_told_in_degrees():
    solution = calibrate_directions({"tilt": 25.0, "roll": 15.0}, level=True)
    assert " degrees" in judge(solution).verdict
    assert " mm" not in judge(solution).verdict


def test_a_phantom_that_does_not_explain_the_images_is_not_blamed_on_the_motion():
    lines = lines_of({"tilt": 25.0, "roll": 15.0, "move": 11.0}, count=400)
    solution = calibrate_plane(lines)
    # The floor bulges, as a sheet of rubber does: 8 mm over 100 mm.
    shift, turn = lines.world_from_sensor.as_components()
    lifted = shift + np.outer(8.0 * np.sum(shift[:, :2] ** 2, axis=1) / 1e4, [0.0, 0.0, 1.0])
    bulging = replace(lines, world_from_sensor=RigidTransform.from_components(lifted, turn))
    wrong = solve_chain(bulging, Plane(), solution.chain, outlier_sigma=np.inf)
    with pytest.raises(InsufficientDataError, match=r"phantom.*\d mm"):
        require_adequate(wrong)
    assert judge(wrong).missing == ()
    assert require_adequate(solution) is solution
