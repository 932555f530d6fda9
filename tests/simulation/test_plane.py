"""Scans of a plane: echoes where geometry says, blurred by the beam, over the motions asked for."""

import numpy as np
import oracles
import pytest
from scipy.signal import hilbert
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import ImageGrid
from speckle3d.simulation import SimulationSettings, simulate
from speckle3d.simulation.bath import Level, RoughSheet, water_bath
from speckle3d.simulation.beam import tabulate_beam
from speckle3d.simulation.scan import SimulatedFrames

FLOOR_Z_MM = -240.0
"""Height of a level floor in the world of the simulated tracker."""


@pytest.fixture(scope="module")
def beam():
    return tabulate_beam()


def plane(**changes):
    return simulate(SimulationSettings(preset="plane", **{"seed": 3, **changes}))[0]


def posed(beam, reflector, poses_deg_mm, vectors=64):
    """Frames at given (tilt, roll, depth in the middle vector)."""
    image = ImageGrid(vectors, 3818, 0.3, beam.probe.signal.sample_spacing_mm)
    poses = []
    for tilt, roll, depth in poses_deg_mm:
        turn = Rotation.from_euler("YXZ", np.deg2rad([40.0, tilt, roll]))
        below = np.array([image.width_mm / 2.0, depth, 0.0])
        poses.append(RigidTransform.from_components([3.0, 0.0, -5.0] - turn.apply(below), turn))
    return SimulatedFrames(beam, water_bath(11, reflector), RigidTransform.concatenate(poses), image)


def envelopes(frame):
    return np.abs(hilbert(frame.astype(float), axis=1))


def mean_profile(frames, index):
    """Mean envelope over vectors against depth below the floor's line, on a grid of 0.01 mm from -6 mm."""
    image, floor = frames.image, Level.floor(frames.medium_from_image[index])
    lateral = np.arange(image.vectors) * image.vector_pitch_mm
    line = (floor.offset_mm - floor.normal[0] * lateral) / floor.normal[1]
    depth = np.arange(image.samples) * image.sample_spacing_mm
    below = np.arange(-6.0, 6.0, 0.01)
    rows = envelopes(frames[index])
    return below, np.mean([np.interp(y + below, depth, row) for y, row in zip(line, rows, strict=True)], 0)


def half_height(below, profile):
    """First and last place where the profile is above half of its maximum."""
    above = np.flatnonzero(profile > profile.max() / 2.0)
    return below[above[0]], below[above[-1]]


def brightness_db(frames, index):
    return 20.0 * np.log10(np.median(envelopes(frames[index]).max(axis=1)))


def seen_angles(sweep, world_normal=(0.0, 0.0, -1.0)):
    """Tilt and roll against the floor, and depth of the floor in the middle vector, from the truth."""
    normal = sweep.truth.rotation.inv().apply(world_normal)
    tilt = np.arcsin(-normal[:, 2])
    roll = np.arctan2(normal[:, 0], normal[:, 1])
    face = sweep.truth.apply(np.array([sweep.grid.width_mm / 2.0, 0.0, 0.0]))
    depth = (face[:, 2] - FLOOR_Z_MM) / normal[:, 1]
    return np.rad2deg(tilt), np.rad2deg(roll), depth


@pytest.mark.slow
def test_the_bars_echo_lies_in_the_plane_that_the_truth_says():
    sweep = plane(reflector="bar", frames=8, snr_db=60.0).sweep
    for i in range(8):
        echo = envelopes(sweep.frames[i])
        row = np.argmax(echo, axis=1)
        # The middle of the main lobe: a clipped echo has a flat top.
        near = row[:, None] + np.arange(-12, 13)
        weight = np.take_along_axis(echo, near, axis=1) ** 2
        depth = (weight * near).sum(axis=1) / weight.sum(axis=1) * sweep.grid.sample_spacing_mm
        lateral = np.arange(len(row)) * sweep.grid.vector_pitch_mm
        points = sweep.truth[i].apply(np.stack([lateral, depth, np.zeros(len(row))], axis=1))
        # A fifth of the wavelength: the converging wavefront shifts echoes by as much before the focus.
        # Slope: 0.04 mm over the image.
        assert np.median(points[:, 2]) == pytest.approx(FLOOR_Z_MM, abs=0.04)
        slope = np.polyfit(lateral, points[:, 2], 1)[0]
        assert abs(slope) * sweep.grid.width_mm < 0.04


@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(10.0, -30.0), (20.0, 30.0), (28.0, -30.0)])
def test_the_walls_first_echo_is_shallower_by_half_the_beams_thickness_times_the_slope(
    beam, depth_mm, tilt_deg
):
    wall = posed(beam, "wall", [(tilt_deg, roll, depth_mm) for roll in (-5.0, 0.0, 5.0, 9.0)], 127)
    below, _ = mean_profile(wall, 0)
    first, last = half_height(below, np.mean([mean_profile(wall, i)[1] for i in range(4)], axis=0))
    bar = posed(beam, "bar", [(tilt_deg, 0.0, depth_mm)])
    pulse = np.ptp(half_height(*mean_profile(bar, 0))) / 2.0
    width = np.interp(depth_mm, beam.depth_mm, oracles.elevational_width_mm(beam))
    # The pulse has a length as well; half widths of a convolution add about as squares.
    expected = np.hypot(width / 2.0 * np.tan(np.deg2rad(30.0)), pulse)
    # Over twelve other seeds both ratios lay between 0.80 and 1.16, mostly below one: speckle raises the
    # maximum whose half counts.
    assert -first == pytest.approx(0.98 * expected, rel=0.2)
    assert last == pytest.approx(0.98 * expected, rel=0.2)


def test_the_wall_fades_when_seen_from_the_side(beam):
    wall = posed(beam, "wall", [(tilt, 0.0, 20.0) for tilt in (0.0, 6.0, 15.0, 25.0)])
    level, slight, oblique, steep = (brightness_db(wall, i) for i in range(4))
    # The lens is 5 mm high, 20 mm away: beyond atan(1 / 8) = 7 deg no mirrored ray comes back, and what is
    # left is diffuse, which hardly depends on the angle.
    assert 3.0 < level - slight < 20.0
    assert 20.0 < level - oblique < 35.0
    assert abs(oblique - steep) < 3.0
    # Still well above the electronic noise of 3.5 counts.
    assert steep > 20.0 * np.log10(100.0)


def test_a_level_wall_reverberates_at_twice_the_depth(beam):
    wall = posed(beam, "wall", [(0.0, 0.0, 14.0), (15.0, 0.0, 14.0)])
    spacing = wall.image.sample_spacing_mm
    below = [envelopes(wall[i])[:, round(21.0 / spacing) : round(35.0 / spacing)] for i in range(2)]
    deepest = 21.0 + np.argmax(below[0], axis=1) * spacing
    # A quarter of the pulse's length.
    assert np.median(deepest) == pytest.approx(28.0, abs=0.05)
    # Once more from floor and face is a loss, but far from noise; seen from the side none returns.
    first = envelopes(wall[0]).max(axis=1)
    assert 0.05 < np.median(below[0].max(axis=1) / first) < 0.6
    assert np.median(below[1].max(axis=1)) < 0.02 * np.median(below[0].max(axis=1))


def test_no_scatterer_of_the_sheet_in_the_box_is_missed():
    sheet = RoughSheet(5)
    turn = Rotation.from_euler("YXZ", [0.8, 0.3, -0.1])
    image_from_sheet = RigidTransform.from_components([18.0, 20.0, 1.0], turn.inv())
    low, high = np.array([-2.7, 1.0, -4.0]), np.array([40.5, 45.0, 4.0])
    found = sheet.near(image_from_sheet, low, high)
    everything = np.concatenate(sheet.tiles((i, j) for i in range(-15, 15) for j in range(-15, 15)))

    def inside(position):
        place = image_from_sheet.apply(position)
        return position[((place >= low) & (place <= high)).all(axis=1)]

    kept, wanted = inside(found), inside(everything)
    assert len(wanted) > 50_000
    np.testing.assert_array_equal(kept[np.lexsort(kept.T)], wanted[np.lexsort(wanted.T)])
    # Tiles about the strip alone: its area and a margin of a tile's diagonal around it.
    assert len(found) < 4 * len(wanted)


def test_the_motion_covers_the_ranges_evenly():
    sweep = plane(sensor_noise=0.0).sweep
    tilt, roll, depth = seen_angles(sweep)
    yaw = np.rad2deg(np.unwrap(np.arctan2(*sweep.truth.rotation.apply([1.0, 0.0, 0.0])[:, [1, 0]].T)))
    # The probe turns back at the ends of a range: tremor goes beyond it a little, frames may just miss it.
    for values, reach in ((tilt, 50.0), (roll, 22.0), (depth, 22.0), (yaw, 180.0)):
        assert np.ptp(values) == pytest.approx(reach, rel=0.05)
        # A uniform distribution's deviation is 0.29 of its range, a sine's 0.35, one that lingers less.
        assert 0.24 < values.std() / reach < 0.36
    assert depth.min() == pytest.approx(12.0, abs=1.0)
    assert np.abs(np.corrcoef([tilt, roll, depth, yaw]) - np.eye(4)).max() < 0.5


def test_sensors_are_left_to_calibrate_and_the_true_mounting_is_told():
    simulated = plane(frames=30, sensor_noise=0.0)
    sweep = simulated.sweep
    assert sweep.tracker.sensor_from_image is None
    assert sweep.orientation.sensor_from_image is None
    times = sweep.frame_time_s
    posed_by = sweep.tracker.readings.at(times - sweep.tracker.time_offset_s) * simulated.tracker_from_image
    error = sweep.truth.inv() * posed_by
    # Interpolation over 20 ms of tremor, with a lever of 280 mm on 0.016 deg: as in the sensors' own tests.
    assert np.abs(error.translation).max() < 0.2
    readings = sweep.orientation.readings.at(times - sweep.orientation.time_offset_s)
    turned = (sweep.truth.rotation.inv() * readings * simulated.orientation_from_image).magnitude()
    assert np.rad2deg(turned).max() < 0.02
    # Far from parallel and from any right angle.
    assert 20.0 < np.rad2deg(np.abs(simulated.tracker_from_image.rotation.as_euler("ZYX"))[1]) < 70.0
    noisy, exact = (s.tracker.readings.world_from_sensor for s in (plane(frames=30).sweep, sweep))
    assert (noisy.translation - exact.translation).std() == pytest.approx(0.15, rel=0.05)


def test_the_beam_is_as_thick_as_its_aperture_makes_it(beam):
    width = oracles.elevational_width_mm(beam)
    # Two-way amplitude of a uniform aperture a at its focus F is sinc(a z / (wavelength F))^2, at half height
    # 0.886 wavelength F / a across; the pulse is broad and the lens weak, hence a tenth.
    wavelength, probe = 1.54 / 7.5, beam.probe
    theory = 0.886 * wavelength * probe.elevation_focus_mm / probe.elevation_aperture_mm
    assert np.interp(20.0, beam.depth_mm, width) == pytest.approx(theory, rel=0.15)
    assert (oracles.elevational_width_mm(beam, -20.0) > width).all()
    # Far beyond the focus it spreads in proportion to the distance from about the focus.
    assert np.interp(40.0, beam.depth_mm, width) > 2.0 * theory
