"""The sensor's samples, and what its quaternion is found to mean."""

import clarius_examples as examples
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import rotations_from_quaternions
from speckle3d.io.clarius import imu
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.reader import sensor_of

TIMES_S = examples.bursts_s(100.0, 102.0)


def moving(degrees=25.0, seed=0):
    return examples.sensor_of(examples.swayed(TIMES_S, degrees), TIMES_S, seed)


def still():
    return examples.sensor_of(examples.swayed(TIMES_S, 0.01), TIMES_S)


def written(tmp_path, text):
    path = tmp_path / "x_imu.yml"
    path.write_text(text)
    return Member(path, path.name, 0, path.stat().st_size)


def found(tmp_path, sensor, quaternions=None):
    samples = imu.read_samples(written(tmp_path, examples.sensor_text(sensor, quaternions)))
    return samples, imu.fits_of(samples)


def meant_as(sensor, meaning):
    """The quaternion of a scanner that means so by it."""
    turn = sensor.readings.world_from_sensor
    turn = turn if meaning.endswith("world from sensor") else turn.inv()
    return turn.as_quat(scalar_first=meaning.startswith("scalar first"))


@pytest.mark.parametrize("meaning", imu.MEANINGS)
def test_the_meaning_of_a_moving_sensors_quaternion_is_found(tmp_path, meaning):
    sensor = moving()
    _, fits = found(tmp_path, sensor, meant_as(sensor, meaning))
    chosen = imu.meaning_of(fits)
    assert chosen.meaning == meaning
    assert not chosen.still
    # Noise of 0.05 m/s^2 tilts by 0.4 deg; trapezoids across bursts of 12 ms and pauses of 50 ms add less.
    assert chosen.off_vertical_deg < 0.6
    assert chosen.off_gyroscope_deg < 0.3
    assert (chosen.world_from_sensor.inv() * sensor.readings.world_from_sensor).magnitude().max() < 1e-9


def test_heading_alone_is_told_by_the_gyroscope(tmp_path):
    """Turned about the vertical, a quaternion and its inverse leave gravity where it is."""
    angles = 30.0 * np.sin(2 * np.pi * 0.4 * TIMES_S)
    sensor = examples.sensor_of(Rotation.from_euler("z", angles[:, None], degrees=True), TIMES_S)
    _, fits = found(tmp_path, sensor, meant_as(sensor, imu.MEANINGS[1]))
    assert imu.meaning_of(fits).meaning == imu.MEANINGS[1]


def test_a_still_sensor_is_believed_by_its_vertical(tmp_path):
    sensor = still()
    _, fits = found(tmp_path, sensor)
    chosen = imu.meaning_of(fits)
    assert chosen.still
    assert chosen.meaning == imu.MEANINGS[0]


def test_a_quaternion_of_something_else_is_refused(tmp_path):
    sensor = moving()
    other = Rotation.random(len(TIMES_S), rng=np.random.default_rng(3)).as_quat()
    samples, fits = found(tmp_path, sensor, other)
    assert imu.meaning_of(fits) is None
    said = dict(row[:2] for row in imu.sensor_rows(samples, fits))["quaternion"]
    assert said == "none that the sensor's other readings agree with: see `speckle3d imu orient`"


def test_a_gyroscope_in_degrees_fits_no_quaternion(tmp_path):
    sensor = moving()
    in_degrees = np.rad2deg(sensor.gyroscope_rad_s)
    text = examples.sensor_text(type(sensor)(**(vars(sensor) | {"gyroscope_rad_s": in_degrees})))
    assert imu.meaning_of(imu.fits_of(imu.read_samples(written(tmp_path, text)))) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_accelerometer_becomes_specific_force_whatever_its_sign(tmp_path, sign):
    sensor = moving()
    signed = type(sensor)(**(vars(sensor) | {"accelerometer_m_s2": sign * sensor.accelerometer_m_s2}))
    samples, fits = found(tmp_path, signed)
    made = imu.orientation_sensor(samples, imu.meaning_of(fits))
    np.testing.assert_allclose(made.accelerometer_m_s2, sensor.accelerometer_m_s2, rtol=1e-12, atol=1e-14)
    up = made.readings.world_from_sensor.apply(made.accelerometer_m_s2).mean(axis=0)
    np.testing.assert_allclose(up, [0.0, 0.0, 9.80665], atol=0.1)


def test_repeated_samples_are_left_out_and_counted(tmp_path):
    rows = examples.sensor_text(moving()).split("---\n")
    # The last burst is sent again, and a sample with the values of the one before it.
    again = rows[:9] + rows[6:9] + [rows[8].replace("timestamp: 10", "timestamp: 11")] + rows[9:]
    plain = imu.read_samples(written(tmp_path, "---\n".join(rows)))
    samples = imu.read_samples(written(tmp_path, "---\n".join(again)))
    assert samples.repeated == 4
    np.testing.assert_array_equal(samples.time_s, plain.time_s)
    np.testing.assert_array_equal(samples.quaternion, plain.quaternion)


def test_pauses_are_told_and_long_ones_not_bridged(tmp_path):
    times = np.concatenate([examples.bursts_s(50.0, 50.5), examples.bursts_s(51.1, 51.4)])
    sensor = examples.sensor_of(examples.swayed(times), times)
    samples, fits = found(tmp_path, sensor)
    rows = dict(row[:2] for row in imu.sensor_rows(samples, fits))
    longest = np.diff(times).max()
    assert rows["sensor, longest pause"] == f"{longest:.3f}"
    assert rows["sensor pauses not bridged"] == "1"
    assert rows["sensor pauses"] == str(np.sum(np.diff(times) > 0.03))
    made = imu.orientation_sensor(samples, imu.meaning_of(fits))
    asked = [50.02, 50.049, times[times < 51].max() + longest / 2, 51.2, 49.99, 60.0]
    assert made.covers(asked).tolist() == [True, True, False, True, False, False]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: [rows[1], rows[0]], "sample 1: timestamp: expected one after .* clock was reset"),
        (lambda rows: [rows[0], rows[0].replace("x: ", "x: 1", 1)], "sample 1: timestamp: expected one af"),
        (lambda rows: [rows[0].replace("timestamp: ", "timestamp: -")], "sample 0: timestamp: expected na"),
        (lambda rows: [rows[0].replace("gyroscope y", "gyro")], "sample 0: gyroscope y: expected a number"),
        (lambda rows: [rows[0].replace("q0: ", "q0: 9")], "sample 0: orientation: expected a unit"),
        (lambda rows: [rows[0].replace("q3", "q4")], "sample 0: orientation: q3: expected a number"),
        (lambda rows: [rows[0], rows[1].replace("magnetometer", "m")], "sample 1: magnetometer: expected o"),
        (lambda _: [], "expected samples of the sensor, got none"),
        (lambda _: ["[1, 2]"], "expected fields, got a list"),
        (lambda rows: [rows[0].replace("scope x: ", "scope x: .nan #")], "gyroscope x: expected a number"),
    ],
)  # fmt: skip
def test_samples_that_make_no_sense_are_named(tmp_path, change, message):
    rows = examples.sensor_text(moving()).split("---\n")
    with pytest.raises(InvalidInputError, match=message):
        imu.read_samples(written(tmp_path, "---\n".join(change(rows))))


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "count", "gaps", "norm", "off_deg", "dip_deg"),
    [("carotid/carotid", 84, 1, 0.921, 0.75, 73), ("wirephantom/phantom", 57, 2, 0.955, 0.47, 61)],
)
def test_real_recordings(realdata, name, count, gaps, norm, off_deg, dip_deg):
    path = realdata / "clarius" / f"{name}_imu.yml"
    samples, _ = sensor_of(path)
    assert len(samples) == count
    fits = imu.fits_of(samples)
    chosen = imu.meaning_of(fits)
    assert chosen.meaning == "scalar first, world from sensor"
    assert chosen.still
    assert chosen.vertical == -1.0
    assert chosen.off_vertical_deg == pytest.approx(off_deg, abs=0.01)
    assert min(each.off_vertical_deg for each in fits[1:]) > 2 * chosen.off_vertical_deg
    made = imu.orientation_sensor(samples, chosen)
    assert np.median(np.linalg.norm(made.accelerometer_m_s2, axis=1)) == pytest.approx(
        norm * 9.80665, abs=0.01
    )
    x, y, z = made.readings.world_from_sensor.apply(made.magnetometer_au).mean(axis=0)
    assert np.rad2deg(np.arctan2(-z, np.hypot(x, y))) == pytest.approx(dip_deg, abs=1)
    assert abs(np.rad2deg(np.arctan2(y, x))) < 8
    assert np.sum(np.diff(samples.time_s) > 0.2) == gaps
    # The gyroscope's step, in rad/s.
    step = np.deg2rad(245 / 32768)
    turns = np.diff(samples.gyroscope_rad_s[:, 0]) / step
    assert np.abs(turns - np.round(turns)).max() < 1e-3
    rotations_from_quaternions(samples.quaternion, "q")
