import time

import numpy as np
import pytest
import simulated_device as simulated
from imu_messages import calibration_message, configuration_message, counts_of, mtdata_payloads
from scipy.spatial.transform import Rotation

from xsens.fusion.online import OnlineState
from xsens.live.device import DeviceInfo
from xsens.live.monitor import LiveState, Monitor, _Attitude
from xsens.logs.samples import ImuLog
from xsens.messages.control import MessageId
from xsens.messages.framing import Message, encode
from xsens.messages.mtdata import DataLayout, OutputMode
from xsens.messages.rawcounts import RawCalibration

RATE_HZ = 100.0
MODE = OutputMode.CALIBRATED | OutputMode.ORIENTATION
INFO = DeviceInfo(7, RATE_HZ, (configuration_message([(MODE, 1)]),))


def sent(indices, iron=0.0) -> bytes:
    """Messages of a level sensor that turns ten degrees per second."""
    stream = b""
    for index in indices:
        acc, gyr, mag, q = simulated.values(index, RATE_HZ, iron)
        names = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au", "quaternion_wxyz", "counter")
        row = dict(zip(names, (acc, gyr, mag, q, index % 65536), strict=True))
        payload = mtdata_payloads(DataLayout(MODE), row)
        stream += encode(Message(MessageId.MT_DATA, payload.tobytes()))
    return stream


@pytest.fixture
def monitor():
    monitor = Monitor()
    monitor.started(INFO)
    return monitor


class TestMonitor:
    def test_says_nothing_before_anything_came(self, monitor):
        state = monitor.state()
        assert (state.samples, state.lost, state.rate_hz, state.connected) == (0, 0, 0.0, True)
        assert state.world_from_sensor is None
        assert state.disturbed is None

    def test_counts_samples_however_the_bytes_are_cut(self, monitor):
        stream = sent(range(50))
        for at in range(0, len(stream), 7):
            monitor.arrived(stream[at : at + 7])
        assert monitor.state().samples == 50

    def test_finds_losses_by_the_counter_between_and_within_what_it_was_told(self, monitor):
        monitor.arrived(sent([65530, 65531, 65533]))
        assert monitor.state().lost == 1
        monitor.arrived(sent([65535, 65536, 65540]))
        assert monitor.state().lost == 1 + 1 + 3
        monitor.arrived(sent([65541]))
        assert monitor.state().lost == 5

    def test_a_damaged_message_is_a_lost_one(self, monitor):
        stream = bytearray(sent(range(20)))
        stream[len(stream) // 2] ^= 1
        monitor.arrived(bytes(stream))
        state = monitor.state()
        assert (state.samples, state.lost) == (19, 1)

    def test_a_sensor_that_starts_anew_has_lost_nothing(self, monitor):
        monitor.arrived(sent(range(1000, 1020)))
        monitor.interrupted("gone")
        monitor.interrupted("still gone")
        away = monitor.state()
        assert (away.connected, away.interruptions, away.note, away.rate_hz) == (False, 1, "still gone", 0.0)
        assert away.world_from_sensor is None
        monitor.started(INFO)
        monitor.arrived(sent(range(5)))
        state = monitor.state()
        assert (state.connected, state.lost, state.samples) == (True, 0, 25)

    def test_the_rate_is_that_of_the_last_states(self, monitor, monkeypatch):
        now_s = 100.0
        monkeypatch.setattr(time, "monotonic", lambda: now_s)
        monitor.started(INFO)
        for step, sent_now in enumerate([50] * 12 + [25] * 12):
            now_s += 0.25
            monitor.arrived(sent(range(50 * step, 50 * step + sent_now)))
            rate_hz = monitor.state().rate_hz
            assert rate_hz == (200.0 if step < 12 else pytest.approx(max(100.0, 200.0 - 12.5 * (step - 11))))

    def test_shows_the_sensors_own_orientation(self, monitor):
        monitor.arrived(sent(range(301)))
        found = monitor.state().world_from_sensor.as_euler("ZYX", degrees=True)
        np.testing.assert_allclose(found, [30.0, 0.0, 0.0], atol=1e-4)

    def test_iron_disturbs_the_field_and_clears(self, monitor):
        monitor.arrived(sent(range(400)))
        assert monitor.state().disturbed is False
        monitor.arrived(sent(range(400, 475), iron=0.3))
        near = monitor.state()
        # (0.74, 0, -0.9): norm and angle below the horizontal.
        assert near.field == pytest.approx(np.hypot(0.74, 0.9), rel=1e-5)
        assert near.dip_rad == pytest.approx(np.arctan2(0.9, 0.74), abs=1e-5)
        assert near.disturbed is True
        monitor.arrived(sent(range(475, 625)))
        assert monitor.state().disturbed is False

    def test_hours_without_a_question_take_no_more_memory(self, monitor):
        stream = sent(range(2000))
        for _ in range(15):
            monitor.arrived(stream)
            assert len(monitor._pending) <= 1 << 14
        assert monitor.state().samples == 30_000

    def test_raw_counts_are_read_with_the_sensors_calibration(self):
        block = RawCalibration(
            100.0, np.reshape(simulated.OFFSETS, (3, 3)), np.reshape(simulated.GAINS, (3, 3)),
            np.stack([np.eye(3)] * 3),
        )  # fmt: skip
        raw = Monitor()
        raw.started(DeviceInfo(1, RATE_HZ, (calibration_message(block),)))
        for first in (0, 100):
            values = [
                simulated.values(index, RATE_HZ, iron=first / 1000)[:3] for index in range(first, first + 100)
            ]
            counts = counts_of(block, np.array(values).transpose(1, 0, 2)).reshape(-1, 9)
            for index, row in enumerate(counts):
                payload = (first + index).to_bytes(2, "big") + row.astype(">u2").tobytes() + b"\x20\x00"
                raw.arrived(encode(Message(MessageId.MT_DATA, payload)))
            field = raw.state().field
            assert field == pytest.approx(np.hypot(0.44 + first / 1000, 0.9), rel=1e-3)
            turned = raw.state().world_from_sensor.as_euler("ZYX", degrees=True)
            # The filter's at the last sample; a tenth of a degree each, counts of 1/7366.
            np.testing.assert_allclose(turned, [(first + 99) / 10, 0.0, 0.0], atol=0.03)


class TestLine:
    def state(self, **changes) -> LiveState:
        usual = {
            "connected": True, "elapsed_s": 12.34, "samples": 3000, "lost": 2, "interruptions": 0,
            "rate_hz": 256.0, "world_from_sensor": None, "field": float("nan"),
            "dip_rad": float("nan"), "note": "",
        }  # fmt: skip
        return LiveState(**(usual | changes))

    def test_says_what_there_is(self):
        assert self.state().line() == "  12.3 s | 3000 samples | 2 lost | 256.0 Hz"

    def test_says_that_the_sensor_is_away(self):
        line = self.state(connected=False, interruptions=1, note="the port is gone").line()
        assert line.endswith("NOT CONNECTED | 1 interruptions | the port is gone")

    @pytest.mark.parametrize(
        ("disturbed", "stray", "verdict"),
        [
            (False, 0.01, " clear"),
            (True, 0.01, " DISTURBED"),
            (False, 0.04, " DISTURBED"),
            (False, float("nan"), ""),
        ],
    )
    def test_says_whether_the_filter_believes_the_field(self, disturbed, stray, verdict):
        no = np.zeros(3)
        fused = OnlineState(Rotation.identity(), no, no, disturbed, False, True, stray, 0.0)
        line = self.state(field=1.05, dip_rad=np.deg2rad(64), fused=fused).line()
        assert line.endswith(f" | field 1.05 dip 64{verdict}")


def test_readings_that_the_filter_refuses_do_not_end_the_display():
    time_s = np.arange(0.0, 2.0, 0.01)
    up, turning, still = (
        np.tile(each, (time_s.size, 1)) for each in ([0, 0, 9.8], [0, 0, 100.0], [0, 0, 0.0])
    )
    attitude = _Attitude(0.01)
    attitude.follow(ImuLog(time_s, up, turning), 0)
    found = attitude.follow(ImuLog(time_s, up, still), 0)
    assert found.world_from_sensor.magnitude() < 1e-6
