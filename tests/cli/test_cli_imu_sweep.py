"""Sensors that rode along: `speckle3d imu` reads them from a sweep."""

import shutil

import h5py
import numpy as np


def test_a_sweeps_own_sensor_is_oriented_anew(run, shipped, tmp_path):
    path = tmp_path / "a.h5"
    shutil.copy(shipped / "phantom.h5", path)
    code, out, err = run("imu", "info", path)
    assert code == 0, err
    with h5py.File(path) as file:
        held = {name: file[f"orientation/{name}"][()] for name in file["orientation"]}
        attributes = {name: np.array(value) for name, value in file["orientation"].attrs.items()}
    assert f"{len(held['time_s'])}" in out.splitlines()[0]
    code, _, err = run("imu", "orient", path, "--into", path, "--replace", "--no-magnetometer")
    assert code == 0, err
    with h5py.File(path) as file:
        found = file["orientation/quaternion_wxyz"][()]
        assert found.shape == held["quaternion_wxyz"].shape
        np.testing.assert_array_equal(file["orientation/time_s"][()], held["time_s"])
        for name, value in attributes.items():
            np.testing.assert_array_equal(file["orientation"].attrs[name], value)
    assert not np.array_equal(found, held["quaternion_wxyz"])
