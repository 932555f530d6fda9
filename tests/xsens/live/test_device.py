import os
from contextlib import closing

import pytest

from xsens.live.device import DeviceSettings, connect, prepare
from xsens.messages.contents import MessageId

pytest.importorskip("serial", reason="needs pyserial")
if not hasattr(os, "openpty"):
    pytest.skip("needs pseudo-terminals", allow_module_level=True)

from simulated_device import DEVICE_ID, KINDS, of_kind, wait_until

BAUD = 115200


class TestDevice:
    @of_kind(*KINDS)
    def test_is_found_and_described_whatever_it_is_doing(self, sensor):
        sensor.wake_s = 0.0
        wait_until(lambda: sensor.state == "measurement")  # of its own accord
        with closing(connect(str(sensor.path))) as device:
            assert device.baud == BAUD
            info = prepare(device, DeviceSettings())
        assert info.device_id == DEVICE_ID
        assert info.header[0].mid == MessageId.CONFIGURATION
        assert (MessageId.EMTS in [message.mid for message in info.header]) == (sensor.kind == "mt9")

    @of_kind("legacy")
    @pytest.mark.parametrize(("content", "mode"), [("raw", 0x4000), ("calibrated", 2), ("orientation", 6)])
    def test_a_legacy_sensor_sends_what_it_is_told_with_its_counter(self, sensor, content, mode):
        with closing(connect(str(sensor.path), BAUD)) as device:
            prepare(device, DeviceSettings(content))
        assert (sensor.mode, sensor.settings, sensor.skip) == (mode, 1, 0)

    @of_kind("mtdata2")
    def test_an_mtdata2_sensor_is_told_item_by_item(self, sensor):
        with closing(connect(str(sensor.path), BAUD)) as device:
            prepare(device, DeviceSettings("orientation", rate_hz=80.0))
        items = dict(sensor.outputs)
        assert {0x1020, 0x1060, 0xE020} == {request for request, rate in items.items() if rate == 0xFFFF}
        assert {0x2010, 0x4020, 0x8020, 0xC020} == {request for request, rate in items.items() if rate == 80}
