"""Logs that are the sensor's bytes, and what holds for logs of every kind."""

import dataclasses
import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from imu_logs import (
    calibration,
    configuration,
    frame_payloads,
    legacy_messages,
    mt9_bin,
    mtdata2_messages,
    samples,
)
from imu_messages import Item, items_payload
from scipy.spatial.transform import Rotation

from xsens.logs.datamessages import parse_stream
from xsens.logs.read import read_log
from xsens.logs.samples import Gap
from xsens.logs.textlogs import write_csv
from xsens.messages.contents import DataLayout, MessageId, OutputMode, OutputSettings, utc_message
from xsens.messages.framing import encode

UNIT = calibration()
COUNTER_SETTING = OutputSettings.COUNTER
EVERYTHING = OutputMode.CALIBRATED | OutputMode.ORIENTATION
VECTORS = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")


@pytest.fixture(scope="module")
def s():
    return samples()


def assert_same_samples(log, s, atol=1e-6, rows=slice(None)):
    """Vectors to float32's 24 bits by default, orientation likewise."""
    for name in VECTORS:
        np.testing.assert_allclose(getattr(log, name), s[name][rows], rtol=0, atol=atol)
    angle = log.world_from_sensor * s["world_from_sensor"][rows].inv()
    assert angle.magnitude().max() < 2 * atol


# The MT9 software's own files


def test_a_file_of_the_mt9_software(s, tmp_path):
    path = tmp_path / "MT9_data_00007154_000.bin"
    path.write_bytes(mt9_bin(s, UNIT, first=41860))
    log = read_log(path)
    assert (len(log), log.rate_hz, log.gaps, log.source) == (200, 256.0, (), str(path))
    np.testing.assert_array_equal(log.counter, 41860 + np.arange(200))
    np.testing.assert_allclose(log.time_s, np.arange(200) / 256)
    for name, gains in zip(VECTORS, UNIT.gains, strict=True):
        assert (np.abs(getattr(log, name) - s[name]) < 0.6 / gains).all()  # half a count
    assert log.world_from_sensor is None
    assert re.findall(r"\d+", log.notes[0]) == ["15", "1", "173"]  # bytes, places, the first byte
    assert "temperature is not compensated" in log.notes[1]


# Legacy data messages


@pytest.mark.parametrize("form", range(4))
@pytest.mark.parametrize("shape", [0x0, 0x4, 0x8])
@pytest.mark.parametrize("world", [0, OutputSettings.NED])
def test_legacy_data_by_their_configuration(s, form, shape, world):
    layout = DataLayout(
        EVERYTHING | 0x0819,  # temperature, analog inputs, position, status
        COUNTER_SETTING | OutputSettings.UTC | shape | form << 8 | world,
    )
    log = parse_stream(configuration(layout) + b"".join(legacy_messages(s, layout)))
    # FP12.20's last bit is 1e-6; of an angle in degrees it is 57 times less.
    assert_same_samples(log, s, atol=2e-6)
    assert log.rate_hz == pytest.approx(100.0)
    assert log.oriented.all()


# Self-describing data messages


@pytest.mark.parametrize("form", range(4))
@pytest.mark.parametrize("world", ["ENU", "NED", "NWU"])
@pytest.mark.parametrize("orientation", ["quaternion", "matrix", "euler"])
def test_self_describing_data_in_every_format_and_world(s, form, world, orientation):
    data = b"".join(mtdata2_messages(s, form=form, world=world, orientation=orientation))
    log = parse_stream(data)
    assert_same_samples(log, s, atol=2e-6)
    assert (log.notes, log.gaps) == ((), ())
    np.testing.assert_allclose(log.time_s, s["time_s"], atol=1e-9)


def test_increments_stand_in_for_rates(s):
    period_s = 0.01
    turns = Rotation.from_rotvec(s["gyroscope_rad_s"] * period_s).as_quat(scalar_first=True)
    payloads = [
        items_payload(
            [
                Item(0x1020, (i,)),
                Item(0x1060, (100 * i,)),
                Item(0x4010, tuple(s["accelerometer_m_s2"][i] * period_s)),
                Item(0x8030, tuple(turns[i])),
            ]
        )
        for i in range(200)
    ]
    log = parse_stream(b"".join(frame_payloads(payloads, MessageId.MT_DATA2)))
    np.testing.assert_allclose(log.accelerometer_m_s2, s["accelerometer_m_s2"], atol=2e-6)
    np.testing.assert_allclose(log.gyroscope_rad_s, s["gyroscope_rad_s"], atol=2e-5)  # 2**-24 over the period
    assert sum("increments" in note for note in log.notes) == 2


# Streams of a live sensor


def test_a_sensor_plugged_in_again_is_away_as_long_as_the_computer_says(s):
    layout = DataLayout(EVERYTHING, COUNTER_SETTING)
    begin = datetime(2026, 2, 28, 23, 59, 58, 500_000, tzinfo=UTC)
    stretches = [
        configuration(layout) + encode(utc_message(begin + timedelta(seconds=away))) + b"".join(messages)
        for away, messages in ((0.0, legacy_messages(s, layout)), (7.25, legacy_messages(s, layout, 5)))
    ]
    log = parse_stream(b"".join(stretches))
    assert len(log) == 400
    assert log.time_s[200] == pytest.approx(7.25)
    assert log.gaps == (Gap(199, 0, pytest.approx(7.25 - 1.99)),)
    assert any("by the computer's clock 1 times" in note for note in log.notes)


# What holds for every kind


def test_plain_files_come_back_exactly(s, tmp_path):
    messages = mtdata2_messages(s)
    del messages[20:25]
    log = parse_stream(b"".join(messages[:100] + messages[101:]), source="a\nlog")
    vectors = log.magnetometer_au.copy()
    vectors[7] = np.nan
    log = dataclasses.replace(log, magnetometer_au=vectors, oriented=np.arange(len(log)) != 9)
    write_csv(tmp_path / "log.csv", log)
    back = read_log(tmp_path / "log.csv")
    for name in ("time_s", "counter", "oriented", *VECTORS):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name))
    assert [(g.after_index, g.lost) for g in back.gaps] == [(19, 5), (99, 1)]
    angle = back.world_from_sensor[log.oriented] * log.world_from_sensor[log.oriented].inv()
    assert angle.magnitude().max() < 1e-15
    text = (tmp_path / "log.csv").read_text(encoding="utf-8")
    assert text.startswith("# source: a log\n")
    assert text.splitlines()[2].startswith("time_s,counter,accelerometer_x_m_s2,")
