"""Calibration with a crossing and with three wires: simulated all ways, and 54 points picked by hand."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, TRIAL_1, centre_of, scan_wires
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import ImagePoints
from calibration.settings import WireFit
from calibration.wires import calibrate_cross_wire, calibrate_wires
from speckle3d.calibrating.phantoms import three_wires
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.wires import WirePhantom

CROSSING_MM = np.array([10.0, -20.0, 30.0])
PLACE = RigidTransform.from_components([100.0, -50.0, 200.0], Rotation.from_euler("xyz", [0.3, -0.2, 1.0]))
ALL_FRAMES = WireFit(outlier_sigma=np.inf)

SKEW = WirePhantom(
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
    centre = centre_of(solution.chain.sensor_from_image, solution.chain.pixel_mm)
    return np.linalg.norm(centre - centre_of(mounting, PIXEL_MM))


@pytest.mark.parametrize("fit_pixels", [True, False])
def test_exact_points_of_a_crossing_give_the_exact_calibration(fit_pixels):
    solution = calibrate_cross_wire(scan_crossing(0), PIXEL_MM, WireFit(fixed_pixels=not fit_pixels))
    np.testing.assert_allclose(solution.chain.sensor_from_image.as_matrix(), TRIAL_1.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(solution.chain.pixel_mm, PIXEL_MM, rtol=1e-9)
    # The phantom's frame has its origin where the wires cross.
    np.testing.assert_allclose(solution.chain.target_from_world.apply(CROSSING_MM), 0.0, atol=1e-7)
    assert len(solution.free) == (11 if fit_pixels else 9)
    assert solution.used.all()


@pytest.fixture(scope="module")
def hand_picks(realdata):
    """54 frames of a crossing, picked by hand to whole pixels."""
    folder = realdata / "cross-wire"
    pixels = np.loadtxt(folder / "crossWirePhantom2DPoints.txt")
    rows = np.loadtxt(folder / "crossWirePhantomTransformations.txt").reshape(-1, 3, 4)
    return pixels, rows


def points_of(pixels, rows):
    poses = RigidTransform.from_components(rows[:, :, 3], Rotation.from_matrix(rows[:, :, :3]))
    return ImagePoints(pixels, np.arange(len(pixels)), poses)


@pytest.mark.realdata
def test_points_picked_by_hand_are_explained_to_a_millimetre(hand_picks):
    solution = calibrate_cross_wire(points_of(*hand_picks), np.full(2, 0.15), ALL_FRAMES)
    assert solution.used.all()
    # 0.980 mm, and as much with nine free numbers instead of a rigid mounting and two scales, which make
    # image axes 89.9 degrees apart: nothing is left that any mounting could explain.
    assert np.sqrt(np.mean(np.sum(solution.residuals**2, axis=1))) <= 1.2
    assert solution.condition_number < 20


@pytest.mark.parametrize("seed", range(2))
def test_any_mounting_and_place_of_three_wires(seed):
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
    angle = (mounting.inv() * solution.chain.sensor_from_image).rotation.magnitude()
    assert angle < np.deg2rad(0.4)
    # In frames on image and phantom every mounting is as good as another: 7.8 to 9.9.
    assert solution.condition_number < 15


@pytest.mark.parametrize(("labels", "with_place"), [([1, 0, 3, 2], False), ([0, 1, 3, 2], True)])
def test_swapped_labels(labels, with_place):
    points = scan_phantom(0, SKEW, 200, noise_mm=0.2, world_from_phantom=PLACE)
    geometry = replace(SKEW, world_from_phantom=PLACE if with_place else None)
    with pytest.raises(InsufficientDataError, match="phantom"):
        calibrate_wires(replace(points, wire=np.array(labels)[points.wire]), geometry)
