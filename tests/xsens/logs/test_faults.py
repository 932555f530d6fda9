"""Readings that are no measurements are missing and cost certainty; what leaves the answer open: refused."""

from dataclasses import replace

import numpy as np
import pytest
from imu_logs import calibration, calibration_message, frame_payloads, mtdata_payloads, raw_values
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError, Speckle3DError
from xsens.fusion.orient import orient
from xsens.logs.datamessages import parse_stream
from xsens.logs.faults import without_faults
from xsens.logs.samples import VECTORS, ImuLog
from xsens.logs.textlogs import parse_text
from xsens.messages.contents import DataLayout, OutputMode
from xsens.messages.framing import encode

RATE_HZ = 100.0
SWING_RAD, SWING_HZ = np.deg2rad(34.4), 0.5


def swinging(seconds=12.0, noise=1.0, speed=1.0):
    """A sensor that rolls to and fro, and its truth."""
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rng, w = np.random.default_rng(4), 2.0 * np.pi * SWING_HZ * speed
    truth = Rotation.from_euler("x", SWING_RAD * np.sin(w * time_s)[:, None])
    rate = np.outer(SWING_RAD * w * np.cos(w * time_s), [1.0, 0.0, 0.0])
    force, field = truth.inv().apply([0.0, 0.0, 9.81]), truth.inv().apply([0.45, 0.0, -0.89])
    vectors = [
        np.round(v + noise * sd * rng.standard_normal(v.shape), 6)
        for v, sd in ((force, 0.02), (rate, 0.01), (field, 0.004))
    ]
    return ImuLog(time_s, *vectors), truth


def with_rows(log, names, change):
    return replace(log, **{name: change(getattr(log, name).copy()) for name in names})


def in_second_half(log):
    """Half of each second."""
    return log.time_s % 1.0 >= 0.5


def repeat_rows(rows, where):
    return rows[np.maximum.accumulate(np.where(where, 0, np.arange(len(rows))))]


def errors(log, truth, method):
    """Largest tilt in degrees, RMS of it and of its claim, and of the heading and its claim."""
    orientation = orient(log, method=method)
    at = np.searchsorted(log.time_s, orientation.rotations.time_s)
    off = np.rad2deg((orientation.rotations.world_from_sensor * truth[at].inv()).as_rotvec())
    sd = np.rad2deg(orientation.standard_deviation_rad)
    tilt, claim = np.hypot(off[:, 0], off[:, 1]), np.hypot(sd[:, 0], sd[:, 1])
    return tilt.max(), *(np.sqrt(np.mean(v**2)) for v in (tilt, claim, off[:, 2], sd[:, 2]))


SENSORS = [VECTORS, *((name,) for name in VECTORS)]


@pytest.mark.parametrize("method", ["smoother", "filter"])
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["zeros", "repeats"])
@pytest.mark.parametrize("names", SENSORS, ids=["all", "accelerometer", "gyroscope", "magnetometer"])
def test_half_of_each_second_gone_is_missing_and_costs_certainty(names, kind, noise, method):
    log, truth = swinging(noise=noise)
    where = in_second_half(log)
    change = {
        "zeros": lambda rows: np.where(where[:, None], 0.0, rows),
        "repeats": lambda rows: repeat_rows(rows, where),
    }[kind]
    faulty = with_rows(log, names, change)
    for name in names:
        rows = getattr(without_faults(faulty), name)
        assert np.isnan(rows).any(axis=1)[where].mean() > 0.9
        assert not np.isnan(rows).any(axis=1)[~where].any()
    worst, tilt, claim, heading, heading_claim = errors(faulty, truth, method)
    assert worst < 2.0
    assert tilt < claim
    assert heading < heading_claim
    if VECTORS[2] not in names or len(names) > 1:
        assert claim > errors(log, truth, method)[2]


@pytest.mark.parametrize("names", SENSORS, ids=["all", "accelerometer", "gyroscope", "magnetometer"])
def test_a_slow_sensor_that_is_stuck_for_a_fifth_of_a_second_is_missing_then(names):
    log, _ = swinging(12.0, speed=0.1)
    where = log.time_s % 1.0 >= 0.8
    faulty = without_faults(with_rows(log, names, lambda rows: repeat_rows(rows, where)))
    for name in names:
        missing = np.isnan(getattr(faulty, name)).any(axis=1)
        assert missing[where].mean() > 0.9
        assert not missing[~where].any()


@pytest.mark.parametrize("code", [-1.0, -999.0])
def test_a_number_that_stands_for_none_is_missing_from_its_first_row(code):
    log, truth = swinging()
    where = log.time_s % 1.0 >= 0.9
    faulty = with_rows(log, VECTORS, lambda rows: np.where(where[:, None], code, rows))
    for name in VECTORS:
        missing = np.isnan(getattr(without_faults(faulty), name)).any(axis=1)
        np.testing.assert_array_equal(missing[20:-20], where[20:-20])
    assert errors(faulty, truth, "filter")[0] < 2.0


def with_every(step, rows, value):
    rows[::step] = value
    return rows


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        (VECTORS[1], lambda rows: np.clip(rows, -1.2, 1.2)),
        (VECTORS[1], lambda rows: np.clip(rows, -1.6, 1.6 + 1e-4 * np.sin(1e6 * rows))),
        (VECTORS[1], lambda rows: (rows + 1.5) % 3.0 - 1.5),
        (VECTORS[1], lambda rows: with_every(97, rows, [25.0, -25.0, 25.0])),
        (VECTORS[2], lambda rows: with_every(97, rows, [9.0, 0.0, 0.0])),
        (VECTORS[0], lambda rows: rows * np.where(np.arange(len(rows))[:, None] < 600, 1.0, [1.0, 1.0, 0.0])),
    ],
    ids=["saturated", "saturated under noise", "wrapped round", "spikes", "a field's spikes", "half dead"],
)
@pytest.mark.parametrize("method", ["smoother", "filter"])
def test_saturation_and_values_no_hand_makes_are_missing(name, spoil, method):
    log, truth = swinging()
    faulty = with_rows(log, [name], spoil)
    wrong = np.abs(getattr(faulty, name) - getattr(log, name)).max(axis=1) > 1e-9
    missing = np.isnan(getattr(without_faults(faulty), name)).any(axis=1)
    assert missing[wrong].mean() > 0.9
    assert missing[~wrong].mean() < 0.02
    worst, tilt, claim, heading, heading_claim = errors(faulty, truth, method)
    assert tilt < claim
    assert heading < heading_claim
    assert worst < 8.0


def test_raw_counts_at_the_end_of_their_range_are_missing():
    log, _ = swinging()
    values_by_name = {"world_from_sensor": None, **{name: getattr(log, name) for name in VECTORS}}
    unit = calibration()
    values = raw_values(values_by_name, unit)
    counts = values["raw_gyroscope"][:, 0]
    middle = np.median(counts)
    wrong = np.abs(counts - middle) > 1000
    values["raw_gyroscope"][:, 0] = np.clip(counts, middle - 1000, middle + 1000)
    records = frame_payloads(mtdata_payloads(DataLayout(OutputMode.MT9), values))
    faulty = parse_stream(encode(calibration_message(unit)) + b"".join(records))
    missing = np.isnan(faulty.gyroscope_rad_s).any(axis=1)
    assert missing[wrong].mean() > 0.9 > 0.02 > missing[~wrong].mean()
    assert "gyroscope" in faulty.notes[-1]


def test_what_a_sensor_may_repeat_is_a_measurement():
    log, _ = swinging()
    coarse = with_rows(log, [VECTORS[1]], lambda rows: np.trunc(rows / 0.0044) * 0.0044)
    slow = with_rows(log, [VECTORS[2]], lambda rows: repeat_rows(rows, np.arange(len(rows)) % 5 > 0))
    resting = ImuLog(
        log.time_s, *(np.tile(v, (len(log), 1)) for v in ([0.0, 0.0, 9.8], [0.0] * 3, [0.4, 0.0, -0.9]))
    )
    for sound in (log, coarse, slow, resting):
        assert without_faults(sound).notes == ()


FACTORS = (np.rad2deg(1.0), np.deg2rad(1.0), 1.5, 0.6, -1.0, 0.0)


MIXINGS = [*(factor * np.eye(3) for factor in FACTORS), np.eye(3)[[1, 0, 2]], np.diag([0.0, 1.0, 1.0])]


@pytest.mark.parametrize("speed", [1.0, 0.2])
@pytest.mark.parametrize("mixing", MIXINGS)
def test_a_gyroscope_in_another_unit_rate_or_axes_or_a_dead_one_raises(mixing, speed):
    log, _ = swinging(20.0, speed=speed)
    with pytest.raises(Speckle3DError, match="gyroscope"):
        orient(with_rows(log, [VECTORS[1]], lambda rows: rows @ mixing))


@pytest.mark.parametrize("method", ["smoother", "filter"])
def test_times_ten_per_cent_wrong_cost_certainty(method):
    log, truth = swinging(20.0)
    _, tilt, claim, *_ = errors(replace(log, time_s=1.1 * log.time_s), truth, method)
    assert tilt < 1.5 * claim


def test_a_magnetometer_on_other_axes_is_left_out_and_a_dead_accelerometer_refused():
    log, _ = swinging(20.0)
    with pytest.raises(InvalidInputError, match="accelerometer's z axis"):
        orient(with_rows(log, [VECTORS[0]], lambda rows: rows * [1.0, 1.0, 0.0]))
    orientation = orient(with_rows(log, [VECTORS[2]], lambda rows: rows[:, [1, 0, 2]] * [1, 1, -1]))
    assert not orientation.magnetic
    assert "magnetometer" in orientation.notes[0]
    assert orient(with_rows(log, [VECTORS[2]], lambda rows: rows + 0.6)).magnetic  # iron on the sensor
    noise = np.random.default_rng(1).standard_normal((2000, 3))
    assert not orient(replace(log, magnetometer_au=noise)).magnetic


NAMES = "time_s," + ",".join(f"{kind}_{axis}" for kind in ("acc", "gyr", "mag") for axis in "xyz")


@pytest.mark.parametrize("shift_s", [4e-4, 0.0])
@pytest.mark.parametrize("whose", ["sensor,", ""])
def test_two_sensors_in_one_table_raise(whose, shift_s):
    log, _ = swinging(4.0)
    rows = [NAMES if not whose else whose + NAMES]
    for time_s, *vectors in zip(log.time_s, *(getattr(log, name) for name in VECTORS), strict=True):
        for sensor in range(2):
            numbers = [time_s + sensor * shift_s, *np.roll(vectors, sensor, axis=1).ravel()]
            rows.append(whose.replace("sensor", f"D4:{sensor}") + ",".join(f"{x:.6f}" for x in numbers))
    with pytest.raises(InvalidInputError, match="sensor"):
        parse_text("\n".join(rows))


def test_a_rate_against_the_times_raises():
    names = "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z"
    rows = [f"{i}\t{100 * i}\t0\t{0.01 * i}\t9.8" for i in range(50)]
    parse_text("\n".join(["// Update Rate: 100.0Hz", names, *rows]))
    with pytest.raises(InvalidInputError, match="stated rate, 10 Hz, got 100 Hz"):
        parse_text("\n".join(["// Update Rate: 10.0Hz", names, *rows]))
