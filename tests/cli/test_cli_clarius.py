"""A Clarius package on the command line: told, converted, and its sensor's orientation found anew."""

import json

import clarius_examples as examples
import numpy as np
from clarius_examples import sweep_of

from speckle3d.io.load import load_sweep


def test_a_package_is_asked_for_what_it_lacks_and_converted(run, refused, tmp_path):
    package = examples.write_package(tmp_path / "x.tar", sweep_of("iq"), packed=True)
    out = tmp_path / "sweep.h5"
    said = refused("convert", package, out)
    assert "--probe" in said
    assert "--bandwidth-hz" in said
    (tmp_path / "import.toml").write_text('probe = "L7 HD3"\nbandwidth_hz = [4e6, 8e6]\n')
    assert run("convert", package, out)[0] == 0
    code, told, _ = run("info", package, "--json")
    assert code == 0
    rows = json.loads(told)
    assert "0.2 mm" in str(rows)
    assert "scalar first, world from sensor" in str(rows)
    plain, made = load_sweep(package), load_sweep(out)
    np.testing.assert_array_equal(made.frames[2], plain.frames[2])
    assert made.signal == plain.signal


def test_the_orientation_of_a_package_is_found_anew(run, tmp_path):
    """Without its quaternion, and without what images would need."""
    sweep = sweep_of("rf")
    wrong = np.tile([0.5, 0.5, 0.5, 0.5], (len(sweep.orientation.readings), 1))
    text = examples.sensor_text(sweep.orientation, wrong)
    package = examples.write_package(tmp_path / "x.tar", sweep, imu_text=text)
    out = tmp_path / "sweep.h5"
    given = ("--probe", "L7 HD3", "--bandwidth-hz", "4e6", "8e6")
    code, _, err = run("convert", package, out, *given)
    assert code == 0
    assert "the sweep has no orientation" in err
    assert load_sweep(out).orientation is None
    rows = {row["description"]: row["value"] for row in json.loads(run("imu", "info", package, "--json")[1])}
    assert rows["lost"] == "0"
    assert int(rows["gaps"]) > 3  # between bursts
    code, _, err = run("imu", "orient", package, "--into", out)
    assert code == 0
    assert "quaternion is not used" in err
    made, true = load_sweep(out).orientation, sweep.orientation
    kept = np.isin(true.readings.time_s, made.readings.time_s)
    assert kept.sum() == len(made.readings) > 15
    # The accelerometer's noise of 0.05 m/s^2 tilts a reading by 0.3 deg; some twenty of them are averaged.
    turns = (made.readings.world_from_sensor, true.readings.world_from_sensor[kept])
    up = [each.inv().apply([0.0, 0.0, 1.0]) for each in turns]
    apart = np.rad2deg(np.arccos(np.clip(np.sum(up[0] * up[1], axis=1), -1, 1)))
    assert apart.max() < 1.0
