"""Calibration with a crossing and with three wires: simulated all ways, and 54 points picked by hand."""

import re
from dataclasses import replace

import numpy as np
import pytest
from calibration_examples import BEAM_DOWN, PIXEL_MM, TRIAL_1, about, centre_of, scan_wires
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import ImagePoints
from calibration.motions import MOTIONS
from calibration.solver import OUTLIER_SIGMA
from calibration.wires import BESIDE_MM, calibrate_cross_wire, calibrate_wires
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.wires import WirePhantom, three_wires

CROSSING_MM = np.array([10.0, -20.0, 30.0])
SWAPPED = np.array([1, 0, 2, 3])
PLACE = RigidTransform.from_components([100.0, -50.0, 200.0], Rotation.from_euler("xyz", [0.3, -0.2, 1.0]))
IMAGE = ("gamma", "beta", "alpha", "x", "y", "z")

SKEW = WirePhantom.from_ends(
    ("a", "b", "c", "d"),
    np.array(
        [
            [[0.0, 0.0, 0.0], [80.0, 0.0, 0.0]],
            [[0.0, 20.0, 0.0], [60.0, 70.0, 10.0]],
            [[10.0, 0.0, 25.0], [20.0, 60.0, 70.0]],
            [[0.0, 40.0, 40.0], [80.0, 20.0, 10.0]],
        ]
    ),
)
"""Four wires, no two of which can take each other's place."""


def scan_crossing(seed, count=60, **options):
    rng = np.random.default_rng(seed)
    pixels, readings = scan_wires(rng, np.tile(CROSSING_MM, (count, 1)), **options)
    return ImagePoints(pixels, np.arange(count), readings)


def scan_phantom(seed, phantom, count=120, **options):
    """Dots 40 mm to both sides of the point named on each wire, one to a frame, the wires by turns."""
    rng = np.random.default_rng(seed)
    wire = np.arange(count) % len(phantom)
    places = phantom.points_mm[wire] + phantom.directions[wire] * rng.uniform(-40, 40, (count, 1))
    pixels, readings = scan_wires(rng, places, **options)
    return ImagePoints(pixels, np.arange(count), readings, wire)


def centre_error_mm(solution, mounting=TRIAL_1):
    found = centre_of(solution.chain.sensor_from_image, solution.chain.pixel_mm)
    return np.linalg.norm(found - centre_of(mounting, PIXEL_MM))


def moved_in_errors(solution, other):
    """How far two solutions are apart, in standard errors of the second."""
    step = (other.chain.sensor_from_image.inv() * solution.chain.sensor_from_image).as_components()
    return np.concatenate([step[1].as_rotvec(), step[0]]) / np.sqrt(np.diag(other.image_covariance(IMAGE)))


@pytest.mark.parametrize("fit_pixels", [True, False])
def test_exact_points_of_a_crossing_give_the_exact_calibration(fit_pixels):
    solution = calibrate_cross_wire(scan_crossing(0), PIXEL_MM, fit_pixels=fit_pixels)
    np.testing.assert_allclose(solution.chain.sensor_from_image.as_matrix(), TRIAL_1.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(solution.chain.pixel_mm, PIXEL_MM, rtol=1e-9)
    # The phantom's frame has its origin where the wires cross.
    np.testing.assert_allclose(solution.chain.target_from_world.apply(CROSSING_MM), 0.0, atol=1e-7)
    assert len(solution.free) == (11 if fit_pixels else 9)
    assert solution.used.all()


def shaken(points, seed, noise_mm):
    """The same, read by a sensor whose position is noisy."""
    shift, turn = points.world_from_sensor.as_components()
    noise = noise_mm * np.random.default_rng([seed, 2]).standard_normal(shift.shape)
    return replace(points, world_from_sensor=RigidTransform.from_components(shift + noise, turn))


@pytest.mark.slow
def test_claimed_standard_errors_of_a_crossing_are_those_of_repetition():
    # Noise of the image alone would not do: it moves tilt and yaw in second order only, which no covariance
    # tells (they are claimed to be twice as uncertain as they are).
    scores = []
    for seed in range(50):
        points = shaken(scan_crossing(seed, noise_mm=0.3), seed, 0.5)
        solution = calibrate_cross_wire(points, beside_mm=0.0)
        shift, turn = (TRIAL_1.inv() * solution.chain.sensor_from_image).as_components()
        claims = np.sqrt(np.diag(solution.image_covariance(IMAGE)))
        scores.append(np.array([*turn.as_rotvec(), *shift]) / claims)
    # The standard deviation of 50 is known to 10 %; three times that.
    np.testing.assert_allclose(np.std(scores, axis=0), 1.0, atol=0.3)


def scan_by_hand(seed, beside_mm, count=90):
    """A crossing kept in the image by a hand that swings in all angles and, out of plane, beside it."""
    rng, time = np.random.default_rng([seed, 9]), np.arange(count) / count

    def swings(reach):
        waves = np.sin(2.0 * np.pi * (rng.uniform(3.0, 9.0, 3) * time[:, None] + rng.random(3))).sum(axis=1)
        return reach * waves / np.abs(waves).max()

    yaw, roll, tilt = (about(axis, swings(np.deg2rad(reach))) for axis, reach in ((2, 90), (2, 11), (0, 25)))
    turn = yaw * BEAM_DOWN * roll * tilt
    place = np.column_stack([20.0 + swings(8.0), 23.0 + swings(11.0), swings(beside_mm)])
    truth = RigidTransform.from_components(CROSSING_MM - turn.apply(place), turn)
    shift, turned = (truth * TRIAL_1.inv()).as_components()
    jitter = Rotation.from_rotvec(5e-4 * rng.standard_normal((count, 3)))
    read = RigidTransform.from_components(shift + 0.15 * rng.standard_normal((count, 3)), jitter * turned)
    # The image tells depths better than what lies beside each other.
    pixels = (place[:, :2] + rng.normal(0.0, [0.25, 0.07], (count, 2))) / PIXEL_MM
    return ImagePoints(pixels, np.arange(count), read, None, 30.0 * time)


@pytest.mark.slow
def test_claims_allow_for_a_hand_that_misses_the_crossing():
    scores, bare = [], []
    for seed in range(20):
        points = scan_by_hand(seed, 0.15)
        for told, beside_mm in ((scores, BESIDE_MM), (bare, 0.0)):
            solution = calibrate_cross_wire(points, PIXEL_MM, beside_mm=beside_mm)
            shift, turn = (TRIAL_1.inv() * solution.chain.sensor_from_image).as_components()
            claims = np.sqrt(np.diag(solution.image_covariance(IMAGE)))
            told.append(np.array([*turn.as_rotvec(), *shift]) / claims)
    # The swings are 0.07 mm RMS, where 0.1 are allowed for; 120 figures, some 60 of them independent.
    assert np.sqrt(np.mean(np.square(scores))) < 1.1
    assert np.mean(np.abs(scores) < 1.96) > 0.93
    # Tilt, yaw and place out of plane, which take up the miss.
    taken = [0, 1, 5]
    assert np.sqrt(np.mean(np.square(bare)[:, taken])) > 1.15 * np.sqrt(np.mean(np.square(scores)[:, taken]))


def test_the_noise_of_a_crossing_is_found():
    solution = calibrate_cross_wire(scan_crossing(0, 400, noise_mm=0.3), outlier_sigma=np.inf)
    # Both components of 0.3 mm lie in the image: over three components it is sqrt(2 / 3) of that. 800 normal
    # numbers know their spread to 2.5 %.
    assert solution.rms == pytest.approx(0.3 * np.sqrt(2 / 3), rel=0.08)


@pytest.mark.parametrize("seed", range(4))
def test_wrong_points_in_a_tenth_of_the_frames_hardly_move_a_crossing(seed):
    points = scan_crossing(seed, 100, noise_mm=0.3)
    wrong = np.random.default_rng([seed, 1]).choice(100, 10, replace=False)
    pixels = points.pixels.copy()
    pixels[wrong] += [60.0, -45.0]
    spoilt = calibrate_cross_wire(replace(points, pixels=pixels))
    assert not spoilt.used[wrong].any()
    assert (np.abs(moved_in_errors(spoilt, calibrate_cross_wire(points))) < 1.0).all()


@pytest.mark.slow
def test_few_right_points_are_lost():
    # Noise lies in the image only, and so is not of one size in the phantom's frame: more than one in 16,000
    # exceeds four robust standard deviations.
    lost = [(~calibrate_cross_wire(scan_crossing(seed, noise_mm=0.3)).used).sum() for seed in range(8)]
    assert np.mean(lost) / 60 < 0.02
    assert OUTLIER_SIGMA == 4.0


@pytest.mark.parametrize(
    ("held", "named"),
    # Where the probe turned about one axis alone, which is which hangs on where the solver came to rest.
    [(("tilt_deg", "roll_deg"), 0), (("tilt_deg", "yaw_deg"), 0), (("roll_deg", "yaw_deg"), 1)],
)
def test_a_crossing_needs_turns_about_two_axes(held, named):
    points = scan_crossing(0, noise_mm=0.3, **dict.fromkeys(held, 0.0))
    with pytest.raises(InsufficientDataError, match=re.escape(MOTIONS[named].advice)):
        calibrate_cross_wire(points)


def test_a_crossing_that_never_turned_needs_turns_about_any_two_axes():
    points = scan_crossing(0, noise_mm=0.3, tilt_deg=0.0, roll_deg=0.0, yaw_deg=0.0)
    with pytest.raises(InsufficientDataError, match=r"turn|rotate") as refused:
        calibrate_cross_wire(points)
    # Which two hangs on where the solver, free to turn, came to rest.
    advice = str(refused.value).partition("): ")[2].split("; and ")
    assert len(advice) == 2
    assert set(advice) <= {motion.advice for motion in MOTIONS if motion.turns}


@pytest.mark.parametrize("held", ["tilt_deg", "roll_deg", "yaw_deg"])
def test_a_crossing_needs_no_more_than_two(held):
    solution = calibrate_cross_wire(scan_crossing(0, noise_mm=0.3, **{held: 0.0}))
    # The standard error is 0.11 to 0.14 mm; four times that.
    assert centre_error_mm(solution) < 0.6


def test_too_few_points_and_a_missing_pixel_size_are_refused():
    with pytest.raises(InsufficientDataError, match="6"):
        calibrate_cross_wire(scan_crossing(0, 5))
    with pytest.raises(InvalidInputError, match="pixel_mm"):
        calibrate_cross_wire(scan_crossing(0), fit_pixels=False)


def test_readings_of_other_frames_are_refused():
    points = scan_crossing(0, 100, noise_mm=0.3)
    order = np.random.default_rng(1).permutation(100)
    with pytest.raises(InsufficientDataError):
        calibrate_cross_wire(replace(points, world_from_sensor=points.world_from_sensor[order]))


@pytest.fixture(scope="module")
def picked(realdata):
    """54 frames of a crossing, picked by hand to whole pixels."""
    folder = realdata / "cross-wire"
    pixels = np.loadtxt(folder / "crossWirePhantom2DPoints.txt")
    rows = np.loadtxt(folder / "crossWirePhantomTransformations.txt").reshape(-1, 3, 4)
    return pixels, rows


def points_of(pixels, rows):
    poses = RigidTransform.from_components(rows[:, :, 3], Rotation.from_matrix(rows[:, :, :3]))
    return ImagePoints(pixels, np.arange(len(pixels)), poses)


@pytest.mark.realdata
def test_points_picked_by_hand_are_explained_to_a_millimetre(picked):
    solution = calibrate_cross_wire(points_of(*picked), outlier_sigma=np.inf)
    assert solution.used.all()
    # 0.980 mm, and as much with nine free numbers instead of a rigid mounting and two scales, which make
    # image axes 89.9 degrees apart: nothing is left that any mounting could explain.
    assert np.sqrt(np.mean(np.sum(solution.residuals**2, axis=1))) <= 1.2
    assert solution.condition_number < 20
    matrix = np.concatenate(
        [picked[0][:, :, None, None] * picked[1][:, None, :, :3], picked[1][:, None, :, :3]], axis=1
    )
    free = np.concatenate([np.moveaxis(matrix, 1, 2).reshape(-1, 9), -np.tile(np.eye(3), (54, 1))], axis=1)
    linear = np.linalg.lstsq(free, -picked[1][:, :, 3].ravel(), rcond=None)[1][0]
    # Errors that wander are weighed as such: not the least sum of squares, but a better mounting.
    assert np.sum(solution.residuals**2) <= 1.06 * linear


@pytest.mark.realdata
def test_what_remains_of_picked_points_is_the_thickness_of_the_beam_and_drift(picked):
    points = points_of(*picked)
    solution = calibrate_cross_wire(points, outlier_sigma=np.inf)
    pose = solution.chain.target_from_image(points)
    columns, rows, out = pose.rotation.inv().apply(solution.residuals).T
    # In the image 0.37 mm across and 0.47 mm along the beam, 2.5 and 3.3 pixels, far more than the 0.3 that
    # whole pixels cost. Out of it, where the crossing is seen for as long as the beam meets it, 0.78 mm.
    assert np.std(columns) < np.std(rows) < 0.6
    assert np.std(out) > 1.4 * np.std(rows)
    # That part is not jitter from frame to frame: its means over nine frames run from -0.8 to 0.8 mm, where
    # jitter of 0.78 mm would leave 0.26. A hand that stops on one side of the beam, or a tracker, drifts so.
    means = out.reshape(-1, 9).mean(axis=1)
    assert np.ptp(means) > 1.0
    # The rotations are rounded to 8.6e-4 of orthonormal; over the 83 mm to the crossing that is 0.02 mm.
    turned = points.world_from_sensor.rotation.as_matrix()
    flat = np.column_stack([points.pixels * solution.chain.pixel_mm, np.zeros(len(points))])
    lever = solution.chain.sensor_from_image.apply(flat)
    rounding = np.einsum("nij,nj->ni", picked[1][:, :, :3] - turned, lever)
    assert np.sqrt(np.mean(np.sum(rounding**2, axis=1))) < 0.05


@pytest.mark.realdata
def test_three_points_in_a_row_that_were_picked_elsewhere_are_noticed(picked):
    points = points_of(*picked)
    solution = calibrate_cross_wire(points)
    # 2 to 3 mm off, all to one side; the answer without them is the same within its standard error.
    np.testing.assert_array_equal(np.flatnonzero(~solution.used), [11, 12, 13])
    assert (np.abs(moved_in_errors(solution, calibrate_cross_wire(points, outlier_sigma=np.inf))) < 1.0).all()


@pytest.mark.realdata
def test_half_of_the_picked_points_may_be_wrong(picked):
    points, rng = points_of(*picked), np.random.default_rng(0)
    wrong = rng.permutation(54) < 28
    pixels = np.where(
        wrong[:, None], rng.uniform(points.pixels.min(0), points.pixels.max(0), (54, 2)), points.pixels
    )
    solution = calibrate_cross_wire(replace(points, pixels=pixels))
    far = np.hypot(*(0.145 * (pixels - points.pixels)).T) > 5.0
    assert not solution.used[far].any()
    # Points 11, 12 and 13 are doubtful.
    assert (~solution.used[~wrong]).sum() <= 3
    assert (np.abs(moved_in_errors(solution, calibrate_cross_wire(points[~wrong]))) < 1.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_any_mounting_and_any_place_of_three_wires_is_found(seed):
    rng = np.random.default_rng([seed, 9])
    mounting, place = (
        RigidTransform.from_components(rng.uniform(-reach, reach, 3), Rotation.random(rng=rng))
        for reach in (150, 300)
    )
    points = scan_phantom(
        seed, three_wires(), noise_mm=0.2, sensor_from_image=mounting, world_from_phantom=place
    )
    solution = calibrate_wires(points, three_wires())
    assert len(solution.free) == 14
    # The standard error of the centre is 0.04 mm, of the worst angle 0.1 degrees; four times that.
    assert centre_error_mm(solution, mounting) < 0.2
    turned = (mounting.inv() * solution.chain.sensor_from_image).rotation.magnitude()
    assert turned < np.deg2rad(0.4)
    # In frames on image and phantom every mounting is as good as another: 7.8 to 9.9.
    assert solution.condition_number < 15


@pytest.mark.parametrize("fit_pixels", [True, False])
def test_exact_dots_give_the_exact_calibration(fit_pixels):
    points = scan_phantom(0, three_wires(), world_from_phantom=PLACE)
    solution = calibrate_wires(points, three_wires(), PIXEL_MM, fit_pixels)
    np.testing.assert_allclose(solution.chain.sensor_from_image.as_matrix(), TRIAL_1.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(solution.chain.pixel_mm, PIXEL_MM, rtol=1e-9)
    assert len(solution.free) == (14 if fit_pixels else 12)
    assert solution.used.all()


@pytest.mark.parametrize(("registration", "count"), [("held", 8), ("turned", 11), ("free", 14)])
def test_a_registered_phantom_is_held_turned_or_found(registration, count):
    points = scan_phantom(0, SKEW, noise_mm=0.2, world_from_phantom=PLACE)
    geometry = replace(SKEW, world_from_phantom=PLACE)
    solution = calibrate_wires(points, geometry, registration=registration)
    assert len(solution.free) == count
    # The standard error is 0.06 to 0.08 mm; four times that.
    assert centre_error_mm(solution) < 0.35


def test_a_registration_that_is_turned_by_a_degree_is_put_right_unless_it_is_held():
    middle = SKEW.ends_mm.reshape(-1, 3).mean(axis=0)
    turn = Rotation.from_rotvec(np.deg2rad([1.0, -1.0, 1.0]))
    about_middle = RigidTransform.from_components(middle - turn.apply(middle), turn)
    points = scan_phantom(0, SKEW, noise_mm=0.2, world_from_phantom=PLACE)
    wrong = replace(SKEW, world_from_phantom=PLACE * about_middle)
    turned, held = (calibrate_wires(points, wrong, registration=how) for how in ("turned", "held"))
    assert centre_error_mm(turned) < 0.35
    assert held.rms > 2 * turned.rms


def test_wires_that_can_take_each_others_place_may_swap_their_labels():
    # Three endless wires at right angles look the same after a quarter turn: only their place changes.
    points = scan_phantom(0, three_wires(), noise_mm=0.2)
    solutions = [
        calibrate_wires(replace(points, wire=np.array(names)[points.wire]), three_wires())
        for names in ([0, 1, 2], [1, 0, 2])
    ]
    first, second = (solution.chain.sensor_from_image.as_matrix() for solution in solutions)
    np.testing.assert_allclose(first, second, atol=1e-5)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_labels_swapped_in_some_frames_are_found_out(share):
    points = scan_phantom(0, three_wires(), noise_mm=0.2)
    chosen = np.random.default_rng(1).random(len(points)) < share
    wire = np.where(chosen, SWAPPED[points.wire], points.wire)
    solution = calibrate_wires(replace(points, wire=wire), three_wires())
    wrong = wire != points.wire
    # One dot in a hundred lies where its wires cross, and is on both.
    assert (wrong & solution.used).sum() <= 1
    assert (~wrong & ~solution.used).sum() <= 1
    assert centre_error_mm(solution) < 0.25


@pytest.mark.parametrize(
    ("labels", "registered"),
    [([0, 1, 3, 2], False), ([1, 0, 3, 2], False), ([0, 1, 3, 2], True), ([1, 0, 2, 3], True)],
)
def test_labels_swapped_throughout_are_refused(labels, registered):
    points = scan_phantom(0, SKEW, 200, noise_mm=0.2, world_from_phantom=PLACE)
    geometry = replace(SKEW, world_from_phantom=PLACE if registered else None)
    with pytest.raises(InsufficientDataError, match="phantom"):
        calibrate_wires(replace(points, wire=np.array(labels)[points.wire]), geometry)


def test_one_wire_leaves_its_own_place_open_and_that_is_said():
    points = scan_phantom(0, three_wires(), 240, noise_mm=0.2)
    with pytest.raises(InsufficientDataError, match="wires"):
        calibrate_wires(points[points.wire == 0], three_wires())


def test_dots_without_wires_too_few_dots_and_unknown_registrations_are_refused():
    points = scan_phantom(0, three_wires(), noise_mm=0.2)
    registered = three_wires(RigidTransform.identity())
    with pytest.raises(InvalidInputError, match="wire"):
        calibrate_wires(replace(points, wire=None), three_wires())
    with pytest.raises(InsufficientDataError, match="6"):
        calibrate_wires(points[:5], registered)
    with pytest.raises(InvalidInputError, match="pixel_mm"):
        calibrate_wires(points, registered, fit_pixels=False)
    with pytest.raises(InvalidInputError, match="registration"):
        calibrate_wires(points, registered, registration="guessed")
