import os
import signal
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest

from speckle3d.core.errors import FileError, InvalidInputError
from xsens.live.device import Device, DeviceError, DeviceSettings
from xsens.live.recording import RawFile, Recorder, record
from xsens.logs.read import read_log
from xsens.messages.control import MessageId
from xsens.messages.framing import decode

pytest.importorskip("serial", reason="needs pyserial")
if not hasattr(os, "openpty"):
    pytest.skip("needs pseudo-terminals", allow_module_level=True)

from simulated_device import KINDS, of_kind, values, wait_until

FAST = DeviceSettings(baud=115200)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.mtb"


def counters(path) -> list[int]:
    """Sample counters in a file: first in an MT9-B's message, last in a legacy one, an item in MTData2."""
    found = []
    for message in decode(path.read_bytes()):
        if message.mid == MessageId.MT_DATA:
            first = len(message.payload) == 22
            found.append(int.from_bytes(message.payload[:2] if first else message.payload[-2:], "big"))
        elif message.mid == MessageId.MT_DATA2:
            found.append(int.from_bytes(message.payload[3:5], "big"))
    return found


class TestRecording:
    @of_kind(*KINDS)
    def test_the_file_holds_all_that_was_sent_after_what_a_reader_needs(self, sensor, path):
        before = datetime.now(UTC)
        states = list(record(str(sensor.path), path, FAST, duration_s=0.6))
        assert counters(path) == sensor.run
        assert states[-1].samples == len(sensor.run) > 20
        assert sensor.state == "configuration"

        messages = decode(path.read_bytes())
        found = [message.mid for message in messages[: 4 if sensor.kind == "legacy" else 5]]
        more = {"mt9": [MessageId.EMTS], "mtdata2": [MessageId.OUTPUT_CONFIGURATION + 1]}.get(sensor.kind, [])
        ack = MessageId.GO_TO_MEASUREMENT_ACK
        data = MessageId.MT_DATA2 if sensor.kind == "mtdata2" else MessageId.MT_DATA
        assert found == [MessageId.CONFIGURATION, *more, MessageId.UTC_TIME, ack, data][: len(found)]
        (told,) = [message.payload for message in messages if message.mid == MessageId.UTC_TIME]
        assert abs(read_utc(told) - before) < timedelta(seconds=5)

        log = read_log(path)
        np.testing.assert_array_equal(log.counter - log.counter[0], np.arange(len(sensor.run)))
        assert log.gaps == ()
        assert log.rate_hz == pytest.approx(sensor.rate_hz, rel=1e-9)
        acc, gyr, mag, _ = values(0, sensor.rate_hz)
        # Half a count of each, of 1268 per m/s², 1250 per rad/s and 7366 per unit of field.
        np.testing.assert_allclose(log.accelerometer_m_s2, np.tile(acc, (len(log), 1)), atol=4e-4)
        np.testing.assert_allclose(log.gyroscope_rad_s, np.tile(gyr, (len(log), 1)), atol=4e-4)
        strength = np.linalg.norm(log.magnetometer_au, axis=1)
        np.testing.assert_allclose(strength, np.linalg.norm(mag), atol=2e-4)
        if sensor.kind != "mt9":
            turned = log.rotations().world_from_sensor
            angle = (turned[0].inv() * turned[-1]).as_rotvec(degrees=True)
            degrees = 10.0 * (len(turned) - 1) / sensor.rate_hz
            np.testing.assert_allclose(angle, [0.0, 0.0, degrees], atol=1e-3)

    def test_each_byte_is_the_operating_systems_as_it_comes(self, sensor, path):
        with Recorder(str(sensor.path), path, FAST):
            wait_until(lambda: len(sensor.run) > 20)
            sensor.settle()
            assert counters(path) == sensor.run  # while it is still being recorded
            sensor.resume()

    @pytest.mark.slow
    def test_killed_it_loses_only_what_was_not_sent(self, sensor, path):
        code = (
            "import sys; from xsens import DeviceSettings, record\n"
            "for state in record(sys.argv[1], sys.argv[2], DeviceSettings(baud=115200)): pass"
        )
        with subprocess.Popen([sys.executable, "-c", code, str(sensor.path), str(path)]) as recording:
            wait_until(lambda: path.exists() and len(counters(path)) > 50, 20.0)
            sensor.settle()
            recording.send_signal(signal.SIGKILL)
        sent = list(sensor.run)
        assert counters(path) == sent
        sensor.resume()
        killed = path.read_bytes()
        list(record(str(sensor.path), path, FAST, append=True, duration_s=0.3))
        assert path.read_bytes().startswith(killed)
        assert counters(path) == sent + sensor.run
        assert len(sensor.run) > 10

    @of_kind(*KINDS)
    def test_unplugged_and_plugged_in_again_it_goes_on_in_the_same_file(self, sensor, path):
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 20)
            sensor.unplug()
            sent = list(sensor.run)
            wait_until(lambda: not recorder.state().connected)
            assert "recording.mtb" not in recorder.state().note
            time.sleep(0.3)
            first = len(sensor.runs)
            sensor.plug()
            wait_until(lambda: recorder.state().connected and len(sensor.runs) > first)
            wait_until(lambda: len(sensor.run) > 20)
            assert recorder.state().interruptions == 1
        assert counters(path) == sent + sensor.run
        stamps = [
            read_utc(each.payload) for each in decode(path.read_bytes()) if each.mid == MessageId.UTC_TIME
        ]
        assert 0.3 < (stamps[1] - stamps[0]).total_seconds() < 8.0

    def test_a_sensor_that_lost_its_power_is_set_again(self, sensor, path):
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 20)
            sensor.settle()
            sensor.power_cycle()
            runs = len(sensor.runs)
            sensor.resume()
            wait_until(lambda: len(sensor.runs) > runs and len(sensor.run) > 20)
            state = recorder.state()
        assert (state.connected, state.interruptions) == (True, 1)
        assert counters(path) == sensor.runs[-2] + sensor.run

    def test_silence_is_noticed_and_asked_about(self, sensor, path, monkeypatch):
        monkeypatch.setattr("xsens.live.recording.SILENCE_S", 0.3)
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 20)
            sensor.mute = True
            wait_until(lambda: not recorder.state().connected)
            sensor.mute = False
            wait_until(lambda: recorder.state().connected)
            assert recorder.state().interruptions == 1

    def test_a_thread_that_has_to_wait_takes_it_for_no_silence(self, sensor, path, monkeypatch):
        monkeypatch.setattr("xsens.live.recording.SILENCE_S", 0.6)
        stalls, receive = threading.Event(), Device.receive

        def stalled(device):
            messages = receive(device)
            if stalls.is_set() and not messages:
                stalls.clear()
                sensor.resume()
                time.sleep(0.8)
            return messages

        monkeypatch.setattr(Device, "receive", stalled)
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 5)
            sensor.settle()
            stalls.set()
            wait_until(lambda: not stalls.is_set() and recorder.state().samples > 100)
            assert recorder.state().interruptions == 0

    @of_kind(*KINDS)
    def test_the_filter_is_loaded_before_measuring_begins(self, sensor, path, monkeypatch):
        told = []
        monkeypatch.setattr(
            "xsens.live.recording.warm_up", lambda: told.append((sensor.state, path.exists()))
        )
        Recorder(str(sensor.path), path, FAST).close()
        assert told == [("configuration", False)]

    def test_another_sensor_is_not_recorded_into_the_same_file(self, sensor, path):
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 20)
            sensor.unplug()
            sent = list(sensor.run)
            sensor.device_id += 1
            sensor.plug()
            wait_until(lambda: "expected sensor" in recorder.state().note)
            assert not recorder.state().connected
        assert counters(path) == sent

    def test_a_slow_display_costs_no_samples(self, sensor, path):
        for state in record(str(sensor.path), path, FAST, interval_s=0.05, duration_s=0.6):
            if not state.samples:
                time.sleep(0.45)
        assert counters(path) == sensor.run

    def test_leaving_the_iteration_ends_the_recording(self, sensor, path):
        for _ in record(str(sensor.path), path, FAST, interval_s=0.1):
            break
        wait_until(lambda: sensor.state == "configuration")
        assert counters(path) == sensor.run

    def test_a_file_that_is_there_is_left_alone(self, sensor, path):
        path.write_bytes(b"precious")
        with pytest.raises(FileError, match=r"recording\.mtb"):
            Recorder(str(sensor.path), path, FAST)
        assert path.read_bytes() == b"precious"

    def test_a_full_disk_ends_the_recording_with_a_file_error(self, sensor, path, monkeypatch):
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: recorder.state().samples > 5)
            monkeypatch.setattr(RawFile, "append", full)
            with pytest.raises(FileError, match="No space left"):
                wait_until(lambda: recorder.state() is None)

    def test_an_answer_of_another_length_is_refused_by_the_ports_name(self, sensor, path, monkeypatch):
        monkeypatch.setattr(sensor, "_configuration", lambda: b"odd")
        with pytest.raises(InvalidInputError, match=r"port: configuration: .*got 3$"):
            Recorder(str(sensor.path), path, FAST)
        assert not path.exists()

    def test_without_a_sensor_there_is_no_file(self, tmp_path, path):
        with pytest.raises(DeviceError, match="none"):
            Recorder(str(tmp_path / "none"), path, FAST)
        assert not path.exists()


def full(self, data):
    raise FileError(f"{self.path}: cannot be written: No space left on device")


class TestGaps:
    @of_kind(*KINDS)
    def test_lost_samples_and_the_time_without_a_plug_are_gaps(self, sensor, path):
        sensor.drop, sensor.corrupt = {5, 6}, {9}
        with Recorder(str(sensor.path), path, FAST) as recorder:
            wait_until(lambda: len(sensor.run) > 20)
            sensor.unplug()
            sensor.drop, sensor.corrupt = set(), set()
            first = len(sensor.run)
            time.sleep(0.5)
            sensor.plug()
            wait_until(lambda: recorder.state().interruptions == 1 and recorder.state().connected)
            wait_until(lambda: len(sensor.run) > 20)
            assert recorder.state().lost == 3
        log = read_log(path)
        assert [(gap.after_index, gap.lost) for gap in log.gaps[:2]] == [(4, 2), (6, 1)]
        away = log.gaps[2]
        assert (len(log.gaps), away.after_index) == (3, first - 1)
        # Half a second, and what it takes to be found, told and started again on a busy computer.
        assert 0.5 < away.duration_s < 5.0


class TestRawFile:
    def test_a_short_write_is_continued(self, path, monkeypatch):
        file = RawFile(path)
        whole = file._file.write
        monkeypatch.setattr(file, "_file", SimpleNamespace(write=lambda data: whole(data[:3])))
        file.append(b"0123456789")
        monkeypatch.undo()
        file.close()
        file.close()
        assert path.read_bytes() == b"0123456789"

    def test_a_folder_that_is_not_there_is_named(self, tmp_path):
        with pytest.raises(FileError, match=r"none/x.mtb.*No such file"):
            RawFile(tmp_path / "none" / "x.mtb")


def read_utc(payload: bytes) -> datetime:
    nanoseconds, year = int.from_bytes(payload[:4], "big"), int.from_bytes(payload[4:6], "big")
    return datetime(year, *payload[6:11], nanoseconds // 1000, tzinfo=UTC)
