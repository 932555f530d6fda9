"""The orientation sensor on the command line: logs told, converted, oriented, put into sweeps, judged."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import sweep_examples
from scipy.spatial.transform import Rotation

from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import load_sweep
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import write_csv

RATE_HZ = 100.0


def turning(seconds=20.0):
    """A sensor that is tilted to and fro, and what it measures without noise."""
    time_s = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    still = np.clip((time_s - 3.0) / 2.0, 0.0, 1.0)
    angle = 0.4 * still * np.sin(2 * np.pi * 0.3 * (time_s - 3.0))
    truth = Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0]))
    between = (truth[:-1].inv() * truth[1:]).as_rotvec() * RATE_HZ
    gyroscope = np.concatenate([between[:1], between])
    force = truth.inv().apply([0.0, 0.0, 9.80665])
    field = truth.inv().apply([0.5, 0.0, -0.86])
    return truth, ImuLog(time_s, force, gyroscope, field, truth, source="test")


@pytest.fixture
def sweep_file(tmp_path):
    path = tmp_path / "sweep.h5"
    write_sweep(path, sweep_examples.rf_sweep())
    return path


@pytest.fixture
def log_file(tmp_path):
    path = tmp_path / "log" / "log.csv"
    path.parent.mkdir()
    write_csv(path, turning()[1])
    return path


def test_every_command_says_that_an_accelerometer_is_in_g(run, tmp_path):
    _, log = turning()
    path = tmp_path / "g.csv"
    write_csv(path, replace(log, accelerometer_m_s2=log.accelerometer_m_s2 / 9.80665))
    code, out, _ = run("imu", "info", path)
    assert code == 0
    assert "in g" in out
    for command in (("convert",), ("orient", "--method", "sensor")):
        code, _, err = run("imu", *command, path, "-o", tmp_path / "out.csv")
        assert code == 0
        assert "in g" in err


def test_an_orientation_goes_into_a_sweep_on_its_own_clock(run, log_file, sweep_file):
    into = ("--into", sweep_file, "--replace", "--time-offset-s", "0.05")
    code, out, err = run("imu", "orient", log_file, *into, "--method", "filter", "--json")
    assert code == 0, err
    assert json.loads(out)["method"] == "filter"
    stream = load_sweep(sweep_file).orientation
    assert stream.time_offset_s == 0.05
    truth, log = turning()
    rotation = stream.readings.at(log.time_s[100:-100])
    error = (truth[100:-100].inv() * rotation).magnitude()
    # Exact readings: what is left is the filter's starting heading and its model of the field. Degrees.
    assert np.rad2deg(error.max()) < 2.0


def test_accuracy_beside_an_optical_tracker(run, tmp_path):
    """A target turned on the sensor, in a world of its own, on a clock 2 s ahead, as TUM text."""
    time_s = np.arange(0.0, 20.0, 1.0 / RATE_HZ)
    angles = 0.5 * np.column_stack([np.sin(time_s), np.sin(0.7 * time_s), np.sin(1.3 * time_s)])
    truth = Rotation.from_euler("zyx", angles)
    off = Rotation.from_rotvec(np.deg2rad(0.4) * np.random.default_rng(1).standard_normal((time_s.size, 3)))
    write_csv(tmp_path / "log.csv", ImuLog(time_s, world_from_sensor=truth * off))
    quaternions = (
        Rotation.from_euler("z", 0.7) * truth * Rotation.from_euler("xyz", [0.3, -0.5, 1.0])
    ).as_quat()
    np.savetxt(
        tmp_path / "target.txt", np.column_stack([time_s + 2.0, np.zeros((len(quaternions), 3)), quaternions])
    )
    arguments = ("imu", "accuracy", tmp_path / "log.csv", "--method", "sensor", "--time-offset-s", "2.0")
    code, out, err = run(*arguments, "--optical", tmp_path / "target.txt", "--json")
    assert code == 0, err
    errors = {row["description"]: row["value"] for row in json.loads(out)}
    for angle in ("roll", "yaw", "tilt"):
        # Two readings of 0.4 degrees each: 0.57; 77 of them leave 10 % open.
        assert 0.45 < errors[f"log: {angle} error, RMS"] < 0.7


def test_no_stream_that_covers_no_frame_goes_into_a_sweep(run, refuse, log_file, sweep_file):
    before = sweep_file.read_bytes()
    orient = ("imu", "orient", log_file, "--into", sweep_file, "--replace", "--time-offset-s")
    line = refuse(*orient, "1e9")
    assert re.search(r"covers 0 of \d+ frames", line)
    assert sweep_file.read_bytes() == before
    assert re.search(r"covers (\d+) of \1 frames", run(*orient, "0")[2])
