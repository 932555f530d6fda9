"""Logs that are the sensor's bytes, and what holds for logs of every kind."""

import dataclasses
import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from imu_logs import (
    calibration,
    configured,
    framed,
    items_of,
    legacy_messages,
    legacy_values,
    mt9_bin,
    mt9_records,
    mtdata2_messages,
    raw_values,
    samples,
)
from imu_messages import Item, calibration_message, configuration_message, items_payload, mtdata_payloads
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import FileError, InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.streams import TimedRotations
from xsens.logs.parts import Hints
from xsens.logs.read import parse_stream, read_log
from xsens.logs.samples import Gap, ImuLog
from xsens.logs.textlogs import write_csv
from xsens.messages.control import MessageId, utc_message
from xsens.messages.framing import Message, encode
from xsens.messages.mtdata import DataLayout, OutputMode, OutputSettings

UNIT = calibration()
COUNTED = OutputSettings.COUNTER
EVERYTHING = OutputMode.CALIBRATED | OutputMode.ORIENTATION
VECTORS = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")


@pytest.fixture(scope="module")
def s():
    return samples()


def assert_same_samples(log, s, atol=1e-6, which=slice(None)):
    """Vectors to float32's 24 bits by default, orientation likewise."""
    for name in VECTORS:
        np.testing.assert_allclose(getattr(log, name), s[name][which], rtol=0, atol=atol)
    turned = log.world_from_sensor * s["world_from_sensor"][which].inv()
    assert turned.magnitude().max() < 2 * atol


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


def test_lost_records_are_gaps_and_wrapped_counters_are_none(s):
    records = mt9_records(s, UNIT, first=65500)
    del records[120:123], records[50]
    log = parse_stream(encode(calibration_message(UNIT)) + b"".join(records))
    assert log.gaps == (
        Gap(49, 1, pytest.approx(2 / 256)),
        Gap(118, 3, pytest.approx(4 / 256)),
    )
    assert log.lost == 4
    assert log.counter[0] == 65500
    assert log.counter[-1] == 65699
    np.testing.assert_allclose(log.time_s[-1], 199 / 256)


def test_raw_counts_with_their_counter_last_are_told_apart(s):
    layout = DataLayout(OutputMode.RAW, COUNTED)
    data = encode(calibration_message(UNIT)) + b"".join(
        framed(mtdata_payloads(layout, raw_values(s, UNIT, 300)))
    )
    assert parse_stream(data).counter[0] == 300


def test_raw_counts_need_a_calibration_block(s):
    with pytest.raises(InvalidInputError, match=r"^stream: .*calibration"):
        parse_stream(b"".join(mt9_records(s, UNIT)))


def test_a_rate_that_is_known_outweighs_the_blocks(s):
    assert parse_stream(mt9_bin(s, UNIT), Hints(rate_hz=128.0)).rate_hz == 128.0
    for rate_hz in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InvalidInputError, match="rate_hz"):
            Hints(rate_hz=rate_hz)


# Legacy data messages


@pytest.mark.parametrize("form", range(4))
@pytest.mark.parametrize("shape", [0, OutputSettings.EULER, OutputSettings.MATRIX])
@pytest.mark.parametrize("world", [0, OutputSettings.NED])
def test_legacy_data_by_their_configuration(s, form, shape, world):
    layout = DataLayout(
        EVERYTHING | OutputMode.TEMPERATURE | OutputMode.AUXILIARY | OutputMode.POSITION | OutputMode.STATUS,
        COUNTED | OutputSettings.UTC | shape | form << 8 | world,
    )
    log = parse_stream(configured(layout) + b"".join(legacy_messages(s, layout)))
    # FP12.20's last bit is 1e-6; of an angle in degrees it is 57 times less.
    assert_same_samples(log, s, atol=2e-6)
    assert log.rate_hz == pytest.approx(100.0)
    assert log.oriented.all()


def test_matrices_are_turned_if_gravity_says_so(s):
    layout = DataLayout(EVERYTHING, COUNTED | OutputSettings.MATRIX)
    values = legacy_values(s, layout)
    values["matrix"] = np.swapaxes(values["matrix"].reshape(-1, 3, 3), 1, 2).reshape(-1, 9)
    log = parse_stream(configured(layout) + b"".join(framed(mtdata_payloads(layout, values))))
    assert_same_samples(log, s, atol=2e-6)
    assert any("taken by columns" in note for note in log.notes)


def test_legacy_data_need_their_configuration(s):
    data = b"".join(legacy_messages(s, DataLayout(EVERYTHING, COUNTED)))
    with pytest.raises(InvalidInputError, match="configuration"):
        parse_stream(data)


def test_legacy_data_without_a_counter_say_so(s):
    layout = DataLayout(EVERYTHING, 0)
    log = parse_stream(configured(layout) + b"".join(legacy_messages(s, layout)))
    assert log.counter is None
    assert any("no counter" in note for note in log.notes)
    np.testing.assert_allclose(log.time_s, s["time_s"], atol=1e-9)


def test_messages_not_as_long_as_configured_are_left_out(s):
    layout = DataLayout(EVERYTHING, COUNTED)
    other = framed([bytes(layout.size - 4)])
    messages = legacy_messages(s, layout)
    log = parse_stream(configured(layout) + b"".join(messages[:10] + other + messages[10:]))
    assert len(log) == 200
    assert any(note.startswith("1 data messages") for note in log.notes)


def test_several_units_behind_a_master_are_refused(s):
    layout = DataLayout(EVERYTHING, COUNTED)
    data = encode(configuration_message([(layout.mode, layout.settings)] * 2))
    with pytest.raises(InvalidInputError, match=r"one unit.*master of 2"):
        parse_stream(data + b"".join(legacy_messages(s, layout)))


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


def test_messages_without_a_measurement_are_no_samples_and_no_loss(s):
    payloads = [items_payload(items_of(s, i, first=i >= 100)) for i in range(200)]
    # Its time is earlier than that of the sample before, as a satellite receiver's is.
    payloads.insert(
        100, items_payload([Item(0x1060, (9_500,)), Item(0x1020, (100,)), Item(0x7010, bytes(94))])
    )
    log = parse_stream(b"".join(framed(payloads, MessageId.MT_DATA2)))
    assert (len(log), log.gaps) == (200, ())
    assert [note.split()[0] for note in log.notes] == ["1"]


def test_items_at_lower_rates_are_missing_in_between(s):
    payloads = [
        items_payload(
            [item for item in items_of(s, i) if i % 4 == 0 or item.identifier not in (0xC020, 0x2010)]
        )
        for i in range(200)
    ]
    log = parse_stream(b"".join(framed(payloads, MessageId.MT_DATA2)))
    there = np.arange(200) % 4 == 0
    np.testing.assert_array_equal(np.isfinite(log.magnetometer_au).all(axis=1), there)
    np.testing.assert_array_equal(log.oriented, there)
    assert_same_samples(
        dataclasses.replace(
            log,
            magnetometer_au=s["magnetometer_au"],
            world_from_sensor=s["world_from_sensor"],
        ),
        s,
    )
    assert len(log.rotations()) == 50
    assert any(note.startswith("150 samples") for note in log.notes)


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
    log = parse_stream(b"".join(framed(payloads, MessageId.MT_DATA2)))
    np.testing.assert_allclose(log.accelerometer_m_s2, s["accelerometer_m_s2"], atol=2e-6)
    np.testing.assert_allclose(log.gyroscope_rad_s, s["gyroscope_rad_s"], atol=2e-5)  # 2**-24 over the period
    assert sum("increments" in note for note in log.notes) == 2


def test_a_quaternion_that_is_none_is_missing(s):
    payloads = [items_of(s, i) for i in range(200)]
    payloads[3][-1] = Item(0x2010, (0.0, 0.0, 0.0, 0.0))
    payloads[4][-1] = Item(0x2010, (float("nan"), 0.0, 0.0, 1.0))
    payloads[5][2] = Item(0x4020, (float("inf"), 0.0, 0.0))
    log = parse_stream(b"".join(framed(map(items_payload, payloads), MessageId.MT_DATA2)))
    assert np.flatnonzero(~log.oriented).tolist() == [3, 4]
    assert np.flatnonzero(np.isnan(log.accelerometer_m_s2).any(axis=1)).tolist() == [5]


# Streams of a live sensor


def test_a_sensor_plugged_in_again_is_away_as_long_as_the_computer_says(s):
    layout = DataLayout(EVERYTHING, COUNTED)
    begin = datetime(2026, 2, 28, 23, 59, 58, 500_000, tzinfo=UTC)
    stretches = [
        configured(layout) + encode(utc_message(begin + timedelta(seconds=away))) + b"".join(messages)
        for away, messages in ((0.0, legacy_messages(s, layout)), (7.25, legacy_messages(s, layout, 5)))
    ]
    log = parse_stream(b"".join(stretches))
    assert len(log) == 400
    assert log.time_s[200] == pytest.approx(7.25)
    assert log.gaps == (Gap(199, 0, pytest.approx(7.25 - 1.99)),)
    assert any("by the computer's clock 1 times" in note for note in log.notes)


def test_messages_of_another_kind_or_unit_are_left_out_and_told(s):
    data = b"".join(mtdata2_messages(s)) + encode(Message(MessageId.MT_DATA, bytes(22)))
    data += encode(Message(MessageId.MT_DATA2, items_payload(items_of(s, 3)), bid=2))
    log = parse_stream(data)
    assert len(log) == 200
    assert [note.split()[0] for note in log.notes] == ["2"]


def test_a_stream_without_data_says_what_it_has():
    with pytest.raises(InvalidInputError, match=r"^stream: .*\b1 .*\b5 bytes"):
        parse_stream(encode(Message(MessageId.WAKE_UP)))
    with pytest.raises(InvalidInputError, match=r"^stream: .*\b1 MTData2"):
        parse_stream(encode(Message(MessageId.MT_DATA2, items_payload([Item(0x1020, (1,))]))))


# What holds for every kind


def test_the_kind_is_told_by_the_content_and_never_the_name(s, tmp_path):
    layout = DataLayout(EVERYTHING, COUNTED)
    (tmp_path / "a.txt").write_bytes(mt9_bin(s, UNIT))
    (tmp_path / "b.csv").write_bytes(configured(layout) + b"".join(legacy_messages(s, layout)))
    (tmp_path / "c.mtb").write_bytes(b"".join(mtdata2_messages(s)))
    write_csv(tmp_path / "d.bin", read_log(tmp_path / "c.mtb"))
    assert [len(read_log(tmp_path / name)) for name in ("a.txt", "b.csv", "c.mtb", "d.bin")] == [200] * 4


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
    assert back.gaps == log.gaps != ()
    turned = back.world_from_sensor[log.oriented] * log.world_from_sensor[log.oriented].inv()
    assert turned.magnitude().max() < 1e-15
    text = (tmp_path / "log.csv").read_text(encoding="utf-8")
    assert text.startswith("# source: a log\n")
    assert text.splitlines()[5].startswith("time_s,counter,accelerometer_x_m_s2,")


def test_plain_files_appear_whole_or_not_at_all(s, tmp_path, monkeypatch):
    log = parse_stream(b"".join(mtdata2_messages(s)))
    with pytest.raises(FileError, match="missing"):
        write_csv(tmp_path / "missing" / "log.csv", log)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(FileError, match=r"log.csv.*No space left"):
        write_csv(tmp_path / "log.csv", log)
    assert list(tmp_path.iterdir()) == []


def test_logs_are_validated():
    time_s = np.arange(3.0)
    with pytest.raises(InvalidInputError, match="time_s"):
        ImuLog(time_s[::-1])
    with pytest.raises(InvalidInputError, match=r"^log: "):
        ImuLog(np.zeros(0))
    with pytest.raises(MismatchError, match=r"gyroscope_rad_s.*\(3, 3\).*\(2, 3\)"):
        ImuLog(time_s, gyroscope_rad_s=np.zeros((2, 3)))
    with pytest.raises(MismatchError, match=r"world_from_sensor.* 3 .* 2"):
        ImuLog(time_s, world_from_sensor=Rotation.identity(2))
    with pytest.raises(MismatchError, match=r"counter.*\(3,\)"):
        ImuLog(time_s, counter=np.arange(4))


def test_the_sensors_own_orientation_is_a_stream():
    rotation = Rotation.from_rotvec(np.outer(np.arange(4), [0.0, 0.0, 0.1]))
    log = ImuLog(
        np.arange(4.0) / 10, world_from_sensor=rotation, oriented=np.array([True, False, True, True])
    )
    stream = log.rotations()
    assert isinstance(stream, TimedRotations)
    assert stream.time_s.tolist() == [0.0, 0.2, 0.3]
    assert stream.at(0.1).as_rotvec() == pytest.approx([0.0, 0.0, 0.1])
    assert log.duration_s == pytest.approx(0.3)
    with pytest.raises(InsufficientDataError):
        ImuLog(np.arange(4.0)).rotations()
