"""Sensors that rode along: `speckle3d imu` reads them from a sweep."""

import shutil

import h5py
import numpy as np


def test_a_sweeps_own_sensor_is_oriented_anew(run, data_folder, tmp_path):
    path = tmp_path / "a.h5"
    shutil.copy(data_folder / "phantom.h5", path)
    code, out, err = run("imu", "info", path)
    assert code == 0, err
    with h5py.File(path) as file:
        before = {name: data[()] for name, data in file["orientation"].items()}
    assert f"{len(before['time_s'])}" in out.splitlines()[0]
    code, _, err = run("imu", "orient", path, "--into", path, "--replace", "--no-magnetometer")
    assert code == 0, err
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["orientation/time_s"][()], before["time_s"])
        assert "sensor_from_image_wxyz" in file["orientation"].attrs
        assert not np.array_equal(file["orientation/quaternion_wxyz"][()], before["quaternion_wxyz"])
