"""Points picked by hand: one on each wire of a frame, and the file that is made of them."""

import numpy as np
import pytest

from speckle3d.io.points import PickedPoints, read_points, write_points

pytest.importorskip("panel")
from speckle3d.app.phantom.picks import Picks


def test_of_each_wire_a_frame_has_the_last_point():
    picks = Picks("xyz")
    picks.put(4, [(1.0, 2.0, "z"), (3.0, 4.0, "x"), (5.00049, 6.0, "z")])
    assert picks.of(4) == [(3.0, 4.0, "x"), (5.0, 6.0, "z")]
    assert picks.missing(4) == ("y",)
    # A point on no wire of the phantom is none.
    picks.put(2, [(1.0, 1.0, "w"), (1.0, 1.0, "")])
    assert picks.frames == (4,)
    picks.put(4, [])
    assert len(picks) == 0


def test_a_frame_has_one_crossing():
    picks = Picks(())
    picks.put(0, [(1.0, 2.0, ""), (3.0, 4.0, "")])
    assert picks.of(0) == [(3.0, 4.0, "")]
    assert picks.points().wire is None


def test_points_are_written_and_read_as_they_are(tmp_path):
    rng = np.random.default_rng(0)
    frame, wire = np.repeat([7, 2, 5], 3), np.tile([2, 0, 1], 3)
    picks = Picks("abc")
    picks.take(frame.tolist(), rng.uniform(0, 300, (9, 2)).tolist(), wire.tolist())
    points = picks.points()
    assert points.frame.tolist() == [2, 2, 2, 5, 5, 5, 7, 7, 7]
    assert points.wire.tolist() == [0, 1, 2] * 3
    write_points(tmp_path / "p.csv", points, "abc")
    again = read_points(tmp_path / "p.csv", "abc")
    assert isinstance(again, PickedPoints)
    np.testing.assert_array_equal(again.pixels, points.pixels)
    np.testing.assert_array_equal(again.frame, points.frame)
