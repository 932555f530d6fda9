import math
from datetime import UTC, datetime

import pytest

from xsens.messages.control import (
    Configuration,
    MessageId,
    utc_message,
    utc_time_s,
)
from xsens.messages.framing import Message


def test_the_configuration_of_a_real_unit():
    """MTi-300, recorded with the vendor's program: 100 Hz, one unit, no legacy output."""
    payload = (
        bytes.fromhex("037003f80480") + bytes(90) + bytes.fromhex("0001037003f8000000000000000100270108")
    )
    payload += bytes.fromhex("02490501")
    assert len(payload) == 118
    c = Configuration.from_message(Message(MessageId.CONFIGURATION, payload))
    assert (c.rate_hz, c.units) == (100.0, ((0, 1),))


def test_the_time_is_told_as_the_sensors_tell_it():
    now = datetime(2024, 2, 29, 23, 59, 58, 123_456, tzinfo=UTC)
    message = utc_message(now)
    assert message == Message(0x61, bytes.fromhex("075bca00 07e8 02 1d 17 3b 3a 07"))
    assert utc_time_s(message) == pytest.approx(now.timestamp(), abs=1e-6)
    for other in (Message(0x61, bytes(12)), Message(0x61, bytes(3)), Message(0x62, message.payload)):
        assert math.isnan(utc_time_s(other))
