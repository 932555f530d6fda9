from dataclasses import fields, replace

import numpy as np
import pytest
import sweep_examples
from calibration_files import ROTATION, example_calibration
from scipy.spatial.transform import Rotation

from speckle3d.cli.common import mount
from speckle3d.core.calibration import calibrated
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.io.family.calibrations import write_calibration


def test_a_pixel_is_where_the_readings_and_the_calibration_put_it():
    sweep = calibrated(sweep_examples.rf_sweep(), example_calibration(time_offset_s=0.0))
    time_s = sweep.tracker.readings.time_s[4]
    world_from_sensor = sweep.tracker.readings.world_from_sensor[4].as_matrix()
    expected = world_from_sensor @ example_calibration().pixel_matrix() @ [3.0, 7.0, 0.0, 1.0]
    position = sweep.tracker.world_from_image(time_s).apply([0.137 * 3.0, 0.138 * 7.0, 0.0])
    np.testing.assert_allclose(position, expected[:3], atol=1e-9)


@pytest.mark.parametrize("name", ["tracker", "orientation"])
@pytest.mark.parametrize("offset_s", [-0.0125, None])
def test_a_calibration_goes_on_its_sensor_and_nothing_else(name, offset_s):
    sweep = sweep_examples.rf_sweep()
    with_calibration = calibrated(sweep, example_calibration(name, time_offset_s=offset_s))
    sensor, before = getattr(with_calibration, name), getattr(sweep, name)
    mounting = sensor.sensor_from_image
    turn = mounting.rotation if name == "tracker" else mounting
    assert (turn.inv() * ROTATION).magnitude() < 1e-12
    assert sensor.time_offset_s == (before.time_offset_s if offset_s is None else offset_s)
    assert sensor.readings is before.readings
    fields_beside = {field.name for field in fields(sweep)} - {name}
    assert all(getattr(with_calibration, field) is getattr(sweep, field) for field in fields_beside)


@pytest.mark.parametrize("sensor", ["tracker", "orientation"])
def test_a_sweep_without_the_sensor_is_refused(sensor):
    sweep = replace(sweep_examples.rf_sweep(), **{sensor: None})
    with pytest.raises(MismatchError):
        calibrated(sweep, example_calibration(sensor))


@pytest.mark.parametrize("sensor", ["tracker", "orientation"])
def test_a_mounting_that_differs_from_the_sweeps_is_told(sensor, tmp_path, capsys):
    sweep = calibrated(sweep_examples.rf_sweep(), example_calibration(sensor))
    remount = example_calibration(sensor, rotation=ROTATION * Rotation.from_euler("y", 17, degrees=True))
    if sensor == "tracker":
        remount = replace(remount, translation_mm=remount.translation_mm + np.array([30.0, 0.0, -40.0]))
    write_calibration(tmp_path / "c.h5", remount)
    mount(sweep, [tmp_path / "c.h5"])
    far = "17 degrees and 50 mm from" if sensor == "tracker" else "17 degrees from"
    assert far in " ".join(capsys.readouterr().err.split())
    unknown = replace(sweep, **{sensor: replace(getattr(sweep, sensor), sensor_from_image=None)})
    mount(unknown, [tmp_path / "c.h5"])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "changes",
    [{"sensor": "camera"}, {"covariance": np.eye(3)}, {"pixel_mm": np.array([0.1, -0.1])}],
)
def test_what_cannot_be_a_calibration_is_refused(changes):
    with pytest.raises(InvalidInputError, match=next(iter(changes))):
        replace(example_calibration(), **changes)
