import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import FileError, InvalidInputError, MismatchError
from speckle3d.io.points import PickedPoints, read_points, write_points

WIRES = ("G1", "7:L1", "2")


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


def test_a_wire_goes_by_its_name_before_its_number(tmp_path):
    path = file_of(tmp_path, "frame,column_px,row_px,wire\n0,1,1,2\n0,2,2,0\n0,3,3,1\n")
    np.testing.assert_array_equal(read_points(path, WIRES).wire, [2, 0, 1])


def test_points_without_wires_have_none(tmp_path):
    points = read_points(file_of(tmp_path, "frame,column_px,row_px\n0,1,2\n0,1,2\n"))
    assert points.wire is None
    assert len(points) == 2


HEAD = "frame,column_px,row_px,wire\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,column_px\n0,1\n", "line 1"),
        ("frame,column_px,row_px,row_px\n", "line 1"),
        ("0,1,2,G1\n", "line 1"),
        ("", "line 1"),
        (HEAD, ".*points"),
        (HEAD + "0,1,2\n", "line 2.*4.*3"),
        (HEAD + "# one\n0,1,2,G1\n0,x,2,G1\n", "line 4: column_px.*'x'"),
        (HEAD + "0,1,inf,G1\n", "line 2: row_px.*'inf'"),
        (HEAD + "0,1,1 2,G1\n", "line 2: row_px.*'1 2'"),
        (HEAD + "0.5,1,2,G1\n", "line 2: frame.*0.5"),
        (HEAD + "-1,1,2,G1\n", "line 2: frame.*-1"),
        (HEAD + "1e30,1,2,G1\n", "line 2: frame"),
        (HEAD + "0,1,2,H9\n", "line 2: wire.*'H9'"),
        (HEAD + "0,1,2,3\n", "line 2: wire"),
        (HEAD + "0,1,2,G1\n\n0,5,5,0\n", "line 4: .*line 2"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path, text, message):
    path = file_of(tmp_path, text)
    with pytest.raises(InvalidInputError, match=f"{re.escape(str(path))}: {message}") as caught:
        read_points(path, WIRES)
    assert "\n" not in str(caught.value)


def test_wires_of_a_phantom_without_any_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="line 2: wire"):
        read_points(file_of(tmp_path, HEAD + "0,1,2,G1\n"))


def test_files_that_cannot_be_read_are_told(tmp_path):
    with pytest.raises(FileError, match="cannot be read"):
        read_points(tmp_path / "none.csv")
    path = tmp_path / "points.csv"
    path.write_bytes(b"frame,column_px,row_px\n0,1,\xff\n")
    with pytest.raises(InvalidInputError, match=r"points\.csv.*UTF-8"):
        read_points(path)


@given(seed=st.integers(0, 2**32 - 1), wired=st.booleans(), named=st.booleans())
@settings(deadline=None, max_examples=25)
def test_what_is_written_is_read_again(tmp_path_factory, seed, wired, named):
    rng = np.random.default_rng(seed)
    frame = np.repeat(np.arange(4), 3)
    wire = np.tile(rng.permutation(3), 4)
    points = PickedPoints(frame, rng.uniform(-5, 900, (12, 2)), wire if wired else None)
    path = tmp_path_factory.mktemp("points") / "points.csv"
    write_points(path, points, WIRES if named else ())
    again = read_points(path, WIRES if named else ("a", "b", "c"))
    np.testing.assert_array_equal(again.frame, frame)
    np.testing.assert_allclose(again.pixels, points.pixels, atol=0.51e-3)  # three digits are written
    if wired:
        np.testing.assert_array_equal(again.wire, wire)
    else:
        assert again.wire is None


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    points = PickedPoints(np.array([0]), np.ones((1, 2)), np.array([1]))
    path = tmp_path / "points.csv"
    for names in (("a,b", "c"), ("#1", "c"), ("a ", "c")):
        with pytest.raises(InvalidInputError, match="name"):
            write_points(path, points, names)
    with pytest.raises(InvalidInputError, match="number 1"):
        write_points(path, points, ("a",))
    assert not path.exists()


def test_arrays_that_do_not_match_are_refused():
    with pytest.raises(MismatchError, match="points"):
        PickedPoints(np.array([0, 1]), np.ones((1, 2)))
    with pytest.raises(InvalidInputError, match="negative number"):
        PickedPoints(np.array([-1]), np.ones((1, 2)))
    with pytest.raises(InvalidInputError, match="finite"):
        PickedPoints(np.array([0]), np.array([[np.nan, 0.0]]))


@pytest.mark.parametrize(
    ("frame", "pixels", "message"),
    [
        (5, (1.0, 2.0), "0 to 4.*frame 5"),
        (4, (9.6, 2.0), "10 columns.*20 rows.*column 9.6, row 2 in frame 4"),
        (4, (1.0, -0.6), "column 1, row -0.6 in frame 4"),
    ],
)
def test_points_of_other_images_are_refused(frame, pixels, message):
    points = PickedPoints(np.array([0, frame]), np.array([(-0.5, 19.5), pixels]))
    with pytest.raises(MismatchError, match=message):
        points.require_inside((5, 10, 20))
    PickedPoints(points.frame[:1], points.pixels[:1]).require_inside((5, 10, 20))
