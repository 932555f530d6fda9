import os
import signal
import sys
import time
from datetime import UTC, datetime

import numpy as np
import pytest

from xsens.live.device import DeviceSettings
from xsens.live.recording import Recorder, record
from xsens.logs.read import read_log
from xsens.messages.contents import MessageId
from xsens.messages.framing import decode

pytest.importorskip("serial", reason="needs pyserial")
if not hasattr(os, "openpty"):
    pytest.skip("needs pseudo-terminals", allow_module_level=True)

from browsers import running
from simulated_device import KINDS, of_kind, wait_until

FAST = DeviceSettings(baud=115200)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.mtb"


def counters(path) -> list[int]:
    """Sample counters in a file: first in an MT9-B's message, last in a legacy one, an item in MTData2."""
    counts = []
    for message in decode(path.read_bytes()):
        if message.mid == MessageId.MT_DATA:
            first = len(message.payload) == 22
            counts.append(int.from_bytes(message.payload[:2] if first else message.payload[-2:], "big"))
        elif message.mid == MessageId.MT_DATA2:
            counts.append(int.from_bytes(message.payload[3:5], "big"))
    return counts


class TestRecording:
    @of_kind(*KINDS)
    def test_the_file_holds_all_that_was_sent_after_what_a_reader_needs(self, sensor, path):
        before = datetime.now(UTC)
        states = list(record(str(sensor.path), path, FAST, duration_s=0.6))
        assert counters(path) == sensor.run
        assert states[-1].samples == len(sensor.run) > 20
        assert sensor.state == "configuration"

        (moment,) = [
            message.payload for message in decode(path.read_bytes()) if message.mid == MessageId.UTC_TIME
        ]
        assert before <= read_utc(moment) <= datetime.now(UTC)
        log = read_log(path)
        np.testing.assert_array_equal(log.counter - log.counter[0], np.arange(len(sensor.run)))
        assert log.gaps == ()
        assert log.rate_hz == pytest.approx(sensor.rate_hz, rel=1e-9)
        if sensor.kind != "mt9":
            rotations = log.rotations().world_from_sensor
            angle = (rotations[0].inv() * rotations[-1]).as_rotvec(degrees=True)
            degrees = 10.0 * (len(rotations) - 1) / sensor.rate_hz
            np.testing.assert_allclose(angle, [0.0, 0.0, degrees], atol=1e-3)

    @pytest.mark.slow
    def test_killed_it_loses_only_what_comes_after(self, sensor, path):
        code = (
            "import sys; from xsens import DeviceSettings, record\n"
            "for state in record(sys.argv[1], sys.argv[2], DeviceSettings(baud=115200)): pass"
        )
        with running([sys.executable, "-c", code, sensor.path, path]) as recording:
            wait_until(lambda: path.exists() and len(counters(path)) > 50)
            sensor.settle()
            recording.send_signal(signal.SIGKILL)
        counts_sent = list(sensor.run)
        assert counters(path) == counts_sent
        sensor.resume()
        before = path.read_bytes()
        list(record(str(sensor.path), path, FAST, append=True, duration_s=0.3))
        assert path.read_bytes().startswith(before)
        assert counters(path) == counts_sent + sensor.run
        assert len(sensor.run) > 10

    @of_kind(*KINDS)
    def test_unplugged_and_plugged_in_again_it_goes_on_in_the_same_file(self, sensor, path):
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 20)
            sensor.unplug()
            counts_sent = list(sensor.run)
            wait_until(lambda: not recorder.state().connected)
            time.sleep(0.3)
            first = len(sensor.runs)
            sensor.plug()
            wait_until(lambda: recorder.state().connected and len(sensor.runs) > first)
            wait_until(lambda: len(sensor.run) > 20)
            assert recorder.state().interruptions == 1
        assert counters(path) == counts_sent + sensor.run


def read_utc(payload: bytes) -> datetime:
    nanoseconds, year = int.from_bytes(payload[:4], "big"), int.from_bytes(payload[4:6], "big")
    return datetime(year, *payload[6:11], nanoseconds // 1000, tzinfo=UTC)
