import numpy as np
import pytest
import simulated_device as device_model
from imu_messages import configuration_message, mtdata_payloads

from xsens.live.recording import Monitor
from xsens.messages.contents import DataLayout, MessageId, OutputMode
from xsens.messages.framing import Message, encode

RATE_HZ = 100.0
MODE = OutputMode.CALIBRATED | OutputMode.ORIENTATION
HEADER = (configuration_message([(MODE, 1)]),)


def stream_of(indices, iron=0.0) -> bytes:
    """Messages of a level sensor that turns ten degrees per second."""
    stream = b""
    for index in indices:
        acc, gyr, mag, q = device_model.values(index, RATE_HZ, iron)
        names = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au", "quaternion_wxyz", "counter")
        row = dict(zip(names, (acc, gyr, mag, q, index % 65536), strict=True))
        payload = mtdata_payloads(DataLayout(MODE), row)
        stream += encode(Message(MessageId.MT_DATA, payload.tobytes()))
    return stream


@pytest.fixture
def monitor():
    monitor = Monitor()
    monitor.take(HEADER)
    return monitor


class TestMonitor:
    def test_losses_are_found_by_the_counter_within_and_between_pieces(self, monitor):
        monitor.take(stream_of([65530, 65531, 65533]))
        assert monitor.state().lost == 1
        monitor.take(stream_of([65535, 65536, 65540]))
        assert monitor.state().lost == 1 + 1 + 3
        monitor.take(stream_of([65541]))
        assert monitor.state().lost == 5

    def test_iron_disturbs_the_field_and_clears(self, monitor):
        monitor.take(stream_of(range(400)))
        assert monitor.state().disturbed is False
        monitor.take(stream_of(range(400, 475), iron=0.3))
        near = monitor.state()
        # (0.74, 0, -0.9): norm and angle below the horizontal.
        assert near.field == pytest.approx(np.hypot(0.74, 0.9), rel=1e-5)
        assert near.dip_rad == pytest.approx(np.arctan2(0.9, 0.74), abs=1e-5)
        assert near.disturbed is True
        monitor.take(stream_of(range(475, 625)))
        assert monitor.state().disturbed is False
