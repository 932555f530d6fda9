"""Streams of messages: in any pieces, with damaged ones among them, and of peers that lie."""

import struct
import tracemalloc

import igtl_examples
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from igtl_examples import LAST, messages_of

from speckle3d.io.igtl.framing import Framing, LostError
from speckle3d.io.igtl.messages import Limits, MessageError

STREAM = igtl_examples.stream()
DEVICES = [
    "ProbeToTracker", "Image_Reference", "Text", "Image_Reference", "StylusToTracker", "Server", "Marks",
    "Image_Reference",
]  # fmt: skip


def fed(content, pieces=1):
    framing, found = Framing(), []
    edges = np.linspace(0, len(content), pieces + 1).astype(int)
    for k in range(pieces):
        found += framing.feed(content[edges[k] : edges[k + 1]])
    return framing, found


def devices(found):
    return [each.device for each in found if not isinstance(each, MessageError)]


@pytest.mark.parametrize("pieces", [1, 2, 100, len(STREAM)])
def test_messages_come_in_order_however_the_stream_is_cut(pieces):
    framing, found = fed(STREAM, pieces)
    assert devices(found) == DEVICES
    assert not framing.within_message


@given(seed=st.integers(0, 2**32 - 1), k=st.integers(0, len(DEVICES) - 1))
@settings(deadline=None, max_examples=60)
def test_a_damaged_message_costs_no_other(seed, k):
    pieces = messages_of(STREAM)
    pieces[k] = igtl_examples.damaged_message(np.random.default_rng(seed), pieces[k])
    found = devices(igtl_examples.received(b"".join(pieces) + LAST))
    others = DEVICES[:k] + DEVICES[k + 1 :]
    expected = [*others, "Last"]
    assert found in (expected, [*DEVICES, "Last"]) or (
        # A header alone may be changed to be another message, which is as whole as it was.
        len(found) == len(expected) + 1 and found[:k] + found[k + 1 :] == expected
    )


def test_a_wrong_check_sum_is_told_and_the_next_message_taken_at_once():
    pieces = messages_of(STREAM)
    pieces[1] = pieces[1][:-1] + bytes([pieces[1][-1] ^ 1])
    _, found = fed(b"".join(pieces))
    assert devices(found) == [*DEVICES[:1], *DEVICES[2:]]
    (refused,) = (each for each in found if isinstance(each, MessageError))
    assert "IMAGE of 'Image_Reference'" in str(refused)


def lying(size, kind=b"IMAGE"):
    """A header that claims a body of another length than the one that follows."""
    fields = list(igtl_examples.HEADER.unpack(igtl_examples.image()[0][:58]))
    fields[1], fields[5] = kind, size
    return igtl_examples.HEADER.pack(*fields)


@pytest.mark.parametrize("size", [2**64 - 1, 2**32, 2**26 + 1, 2**26, 10**6])
def test_a_huge_size_neither_takes_memory_nor_the_messages_behind_it(size):
    tracemalloc.start()
    try:
        _, found = fed(lying(size) + igtl_examples.image()[0][58:] + LAST, 3)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()
    assert devices(found) == ["Last"]
    assert isinstance(found[0], MessageError)


def test_a_wrong_size_of_a_small_message_is_found_when_the_stream_goes_on():
    transforms = [igtl_examples.transform(f"T{k}")[0] for k in range(100)]
    _, found = fed(lying(3000, b"TRANSFORM") + b"".join(transforms), 50)
    assert devices(found) == [f"T{k}" for k in range(100)]


def test_a_peer_that_stops_within_a_message_is_owed_to_and_can_be_given_up():
    framing, found = fed(STREAM + LAST[:90])
    assert devices(found) == DEVICES
    assert framing.within_message
    framing.skip()
    assert devices(framing.feed(LAST)) == ["Last"]


def test_bytes_of_something_else_are_refused_once_and_take_no_memory():
    framing, found = Framing(), []
    noise = np.random.default_rng(0).bytes(2**20)
    for _ in range(8):
        found += framing.feed(noise)
    assert [type(each) for each in found] == [MessageError]
    assert not framing.within_message
    assert devices(framing.feed(LAST)) == ["Last"]


def test_a_peer_that_sends_only_headers_of_nothing_is_left():
    framing = Framing(Limits(max_other_body_bytes=1000))
    crowd = lying(900, b"TRANSFORM") * 20000
    with pytest.raises(LostError, match="OpenIGTLink"):
        for _ in framing.feed(crowd):
            pass


def test_a_whole_message_behind_a_wrong_size_is_found_within_it():
    body = LAST + bytes(200)
    _, found = fed(lying(len(body), b"POINT") + body + igtl_examples.image()[0])
    assert devices(found) == ["Last", "Image_Reference"]


def test_a_query_has_no_body_and_nothing_else_may_be_without():
    query = struct.pack("> H 12s 20s II Q Q", 1, b"GET_STATUS", b"", 0, 0, 0, 0)
    empty = struct.pack("> H 12s 20s II Q Q", 1, b"TRANSFORM", b"a", 0, 0, 0, 0)
    _, found = fed(query + empty + LAST)
    assert [type(each).__name__ for each in found] == ["Other", "MessageError", "TransformReceived"]
