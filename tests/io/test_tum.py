import warnings

import numpy as np
import pytest
from drifting import hand_sweep

from speckle3d.io.tum import is_tum, read_tum, write_tum


def test_what_is_written_is_read_back(tmp_path):
    poses = hand_sweep(np.random.default_rng(3), 30)
    times = np.arange(30) / 30.0
    write_tum(tmp_path / "a.tum", times, poses)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.time_s, times)
    # Rounding of a product with 1000 and of a quaternion's norm.
    np.testing.assert_allclose(back.world_from_sensor.as_matrix(), poses.as_matrix(), rtol=0, atol=1e-12)


def test_columns_are_metres_and_a_quaternion_scalar_last(tmp_path):
    (tmp_path / "a.tum").write_text("# hand\n0 0.001 0 0 0 0 0 1\n\n1 0 0.002 0 0 0 1 0\n")
    matrices = read_tum(tmp_path / "a.tum").world_from_sensor.as_matrix()
    np.testing.assert_allclose(matrices[0, :3, 3], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(np.diag(matrices[1]), [-1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    "bad",
    [
        "2 nan 0 0 0 0 0 1",
        "0 9 9 9 0 0 0 1",
        "99 0 0 0 0 0 0 1",
    ],
)
def test_a_bad_line_costs_that_line(tmp_path, bad):
    lines = [f"{i} {i} 0 0 0 0 0 1" for i in range(6)]
    lines.insert(2, bad)
    (tmp_path / "a.tum").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match=r"a\.tum: poses: 1 of 7 left out.*longest gap is 1 s"):
        poses = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(poses.time_s, np.arange(6.0))
    np.testing.assert_array_equal(poses.world_from_sensor.translation[:, 0], 1000 * np.arange(6.0))


@pytest.mark.parametrize(
    "heading",
    [
        "# timestamp tx ty tz qw qx qy qz",
        "timestamp tx ty tz qw qx qy qz",
        "#timestamp,tx,ty,tz,qw,qx,qy,qz",
        "# t, x, y, z, q_w, q_x, q_y, q_z",
    ],
)
def test_a_heading_says_that_quaternions_are_scalar_first(tmp_path, heading):
    (tmp_path / "a.tum").write_text(f"{heading}\n0 0 0 0 1 0 0 0\n1 0 0 0 0 0 0 1\n")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a heading that is no comment is a line of no use
        rotation = read_tum(tmp_path / "a.tum").world_from_sensor.rotation
    np.testing.assert_allclose(rotation.as_quat(scalar_first=True), [[1, 0, 0, 0], [0, 0, 0, 1]], atol=1e-12)


def test_a_file_says_its_own_unit_against_any_option(tmp_path):
    path, head = tmp_path / "windows.tum", b"# time_s x_mm y_mm z_mm qx qy qz qw\r\n"
    path.write_bytes(b"\xef\xbb\xbf" + head + b"0 1 0 0 0 0 0 1\r\n1 2 0 0 0 0 0 1\r\n")
    assert is_tum(path)
    np.testing.assert_array_equal(read_tum(path).world_from_sensor.translation[:, 0], [1.0, 2.0])
