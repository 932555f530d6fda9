from xsens.messages.contents import (
    Configuration,
    MessageId,
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
