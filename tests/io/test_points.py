import numpy as np
import pytest

from speckle3d.core.errors import FileError, InvalidInputError, MismatchError
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
    assert (plain.wire, len(plain)) == (None, 2)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("frame,column_px\n0,1\n", 1),
        ("0,1,2,G1\n", 1),
        ("", 1),
        (HEAD + "0,1,2\n", 2),
        (HEAD + "# one\n0,1,2,G1\n0,x,2,G1\n", 4),
        (HEAD + "0,1,inf,G1\n", 2),
        (HEAD + "0.5,1,2,G1\n", 2),
        (HEAD + "-1,1,2,G1\n", 2),
        (HEAD + "1e30,1,2,G1\n", 2),
        (HEAD + "0,1,2,H9\n", 2),
        (HEAD + "0,1,2,3\n", 2),
        (HEAD + "0,1,2,G1\n\n0,5,5,0\n", 4),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path, text, line):
    with pytest.raises(InvalidInputError, match=rf"points\.csv: line {line}: ") as caught:
        read_points(file_of(tmp_path, text), WIRES)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_told(tmp_path):
    with pytest.raises(FileError, match="cannot be read"):
        read_points(tmp_path / "none.csv")
    with pytest.raises(InvalidInputError, match="points below the heading"):
        read_points(file_of(tmp_path, HEAD), WIRES)


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


@pytest.mark.parametrize("names", [("a,b", "c"), ("#1", "c"), ("a ", "c"), ("a",)])
def test_what_could_not_be_read_again_is_not_written(tmp_path, names):
    points = PickedPoints(np.array([0]), np.ones((1, 2)), np.array([1]))
    with pytest.raises(InvalidInputError):
        write_points(tmp_path / "points.csv", points, names)
    assert not (tmp_path / "points.csv").exists()


def test_arrays_and_images_that_do_not_match_are_refused():
    with pytest.raises(MismatchError):
        PickedPoints(np.array([0, 1]), np.ones((1, 2)))
    with pytest.raises(InvalidInputError):
        PickedPoints(np.array([-1]), np.ones((1, 2)))
    inside = PickedPoints(np.array([0]), np.array([(-0.5, 19.5)]))
    inside.require_inside((5, 10, 20))
    for frame, pixels in ((5, (1.0, 2.0)), (4, (9.6, 2.0)), (4, (1.0, -0.6))):
        with pytest.raises(MismatchError, match=f"frame {frame}"):
            PickedPoints(np.array([frame]), np.array([pixels])).require_inside((5, 10, 20))
