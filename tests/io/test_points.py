import numpy as np
import pytest

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.points import PickedPoints, read_points, write_points

WIRES = ("G1", "7:L1", "2")
HEAD = "frame,column_px,row_px,wire\n"


def file_of(tmp_path, text):
    path = tmp_path / "points.csv"
    path.write_bytes(text.encode("utf-8"))
    return path


def test_points_are_read_in_any_order_of_columns(tmp_path):
    heading = "\ufeff# picked\r\n\r\nrow_px, wire ,Frame,column_px\r\n"
    text = heading + "191.9,G1,3,605.7 # dim\r\n181.1,7:L1,0,4e2\r\n"
    points = read_points(file_of(tmp_path, text), WIRES)
    np.testing.assert_array_equal(points.frame, [3, 0])
    np.testing.assert_array_equal(points.pixels, [[605.7, 191.9], [400.0, 181.1]])
    np.testing.assert_array_equal(points.wire, [0, 1])


def test_a_wire_goes_by_its_name_before_its_number_or_there_are_none(tmp_path):
    path = file_of(tmp_path, HEAD + "0,1,1,2\n0,2,2,0\n0,3,3,1\n")
    np.testing.assert_array_equal(read_points(path, WIRES).wire, [2, 0, 1])
    plain = read_points(file_of(tmp_path, "frame,column_px,row_px\n0,1,2\n0,1,2\n"))
    assert (plain.wire, len(plain.frame)) == (None, 2)
    with pytest.raises(InvalidInputError, match="line 2"):
        read_points(file_of(tmp_path, "frame,column_px,row_px\n-1,1,2\n"))


@pytest.mark.parametrize("names", [WIRES, ()])
@pytest.mark.parametrize("wire", [np.tile([2, 0, 1], 4), None])
def test_what_is_written_is_read_again(tmp_path, names, wire):
    points = PickedPoints(
        np.repeat(np.arange(4), 3), np.random.default_rng(1).uniform(-5, 900, (12, 2)), wire
    )
    write_points(tmp_path / "points.csv", points, names)
    again = read_points(tmp_path / "points.csv", names or ("a", "b", "c"))
    np.testing.assert_array_equal(again.frame, points.frame)
    np.testing.assert_allclose(again.pixels, points.pixels, atol=0.51e-3)  # three digits are written
    np.testing.assert_array_equal(again.wire, wire)
