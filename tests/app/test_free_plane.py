"""The plane that is dragged: what a person holds stays under the mouse."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.app.reconstruction.cuts.free_plane import FreePlane, SweepAxes
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.cuts.oblique import turned_frame_plane
from speckle3d.imaging.cuts.planes import ReslicePlane

GRID = ImageGrid(vectors=20, samples=100, vector_pitch_mm=1.0, sample_spacing_mm=0.4)
TURN = Rotation.from_rotvec([0.3, -0.7, 1.1])
POSES = RigidTransform.from_components(TURN.apply([[1.0, 2.0, 0.5 * k] for k in range(31)]), TURN)
AXES = SweepAxes.of(GRID, POSES)

planes = st.builds(FreePlane, st.floats(-9, 9), st.floats(-170, 170), st.floats(-80, 80))
places = st.tuples(st.floats(-10, 10), st.floats(-10, 10)).map(np.array)
cuts = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3)).map(
    lambda turn: ReslicePlane(
        RigidTransform.from_components(AXES.centre_mm, Rotation.from_rotvec(turn)),
        20.0,
        20.0,
        0.5,
        (-10.0, -10.0),
    )
)

few = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def off_plane_mm(plane, points_mm):
    normal = AXES.axes_of(plane).as_matrix()[:, 2]
    return (points_mm - AXES.centre_mm) @ normal - plane.shift_mm


def test_its_presets_are_the_cuts_that_they_name():
    lateral, axial, elevational = AXES.world_from_axes.as_matrix().T
    for plane, normal in (
        (FreePlane(), elevational),
        (FreePlane(0, 90, 0), -lateral),
        (FreePlane(0, 0, 90), -axial),
    ):
        np.testing.assert_allclose(AXES.axes_of(plane).as_matrix()[:, 2], normal, atol=1e-12)


def test_its_turn_is_that_of_a_turned_frame():
    middle = POSES[len(POSES) // 2]
    expected = turned_frame_plane(middle, GRID.width_mm / 2, 30.0)
    np.testing.assert_allclose(
        AXES.axes_of(FreePlane(0, 30, 0)).as_matrix(), expected.rotation.as_matrix(), atol=1e-9
    )


@few
@given(planes, cuts)
def test_its_line_in_a_cut_is_in_both(plane, cut):
    found = AXES.line_in(plane, cut)
    if found is None:
        return
    normal, offset = found
    points = offset * normal + np.outer([-5.0, 0.0, 7.0], [-normal[1], normal[0]])
    np.testing.assert_allclose(off_plane_mm(plane, cut.world_from_mm(*points.T)), 0.0, atol=1e-9)


@few
@given(planes, cuts, places, places)
def test_a_moved_point_of_the_plane_stays_on_it(plane, cut, old, step):
    before = off_plane_mm(plane, cut.world_from_mm(*old))
    moved = AXES.moved(plane, cut, old, old + step)
    np.testing.assert_allclose(off_plane_mm(moved, cut.world_from_mm(*(old + step))), before, atol=1e-9)
    assert (moved.turn_deg, moved.tilt_deg) == (plane.turn_deg, plane.tilt_deg)


@few
@given(planes, cuts, places, st.floats(-3.0, 3.0))
def test_a_turned_plane_holds_the_pivot_and_turns_its_line(plane, cut, pivot, angle):
    turned = AXES.turned(plane, cut, pivot, angle)
    assert off_plane_mm(turned, cut.world_from_mm(*pivot)) == pytest.approx(0.0, abs=1e-9)
    before, after = AXES.line_in(plane, cut), AXES.line_in(turned, cut)
    if before is not None and after is not None:
        c, s = np.cos(angle), np.sin(angle)
        np.testing.assert_allclose(after[0], np.array([[c, -s], [s, c]]) @ before[0], atol=1e-7)


def test_its_place_is_written_in_numbers_that_a_command_can_repeat():
    place = AXES.place(FreePlane(1.23456789, 33.3, -12.1), 0.2, 0.5)
    for vector in (place.origin_mm, place.right, place.down):
        np.testing.assert_array_equal(vector, [float(f"{each:.6f}") for each in vector])
