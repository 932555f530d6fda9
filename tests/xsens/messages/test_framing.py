import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from xsens.messages.contents import MessageId
from xsens.messages.framing import Framer, Message, decode, encode, find_frames

FEW = settings(max_examples=40)

messages = st.builds(
    Message,
    mid=st.integers(0, 255),
    payload=st.binary(max_size=300),
    bid=st.integers(0, 255),
)


def test_the_vendors_examples():
    data = ("faff3000d1", "faff0304037003f88c", "fa013000cf")
    messages = [Message(0x30), Message(0x03, bytes.fromhex("037003f8")), Message(0x30, bid=1)]
    assert decode(bytes.fromhex("".join(data))) == messages
    assert tuple(encode(message).hex() for message in messages) == data


# Framing in the presence of damage


def stream(count=50, size=22):
    rng = np.random.default_rng(1)
    return [Message(MessageId.MT_DATA, rng.integers(0, 256, size, np.uint8).tobytes()) for _ in range(count)]


def test_a_bad_checksum_and_lost_bytes_cost_the_messages_they_hit():
    messages = stream()
    pieces = [bytearray(encode(m)) for m in messages]
    pieces[10][8] ^= 0x40
    del pieces[20][5:9]
    frames = find_frames(b"".join(pieces))
    assert list(frames.messages()) == [m for i, m in enumerate(messages) if i not in (10, 20)]
    assert frames.gaps() == [(270, 27), (540, 23)]


def test_of_two_that_overlap_the_one_that_another_follows_is_a_message():
    inner, after = encode(Message(0x32, b"abc")), Message(MessageId.GO_TO_CONFIG)
    outer = Message(0x36, b"xx" + inner + b"yy")
    assert decode(encode(outer) + encode(after)) == [outer, after]
    # What only looks like the beginning of a message, by chance as long as to end in the next one.
    false = encode(Message(0x36, b"xx" + inner + encode(after)[:3]))
    assert decode(false[:-4] + encode(after)) == [Message(0x32, b"abc"), after]


@FEW
@given(st.lists(messages, max_size=8), st.lists(st.integers(1, 400), max_size=40))
def test_a_framer_finds_the_same_whatever_pieces_a_stream_comes_in(messages, pieces):
    data = b"".join(map(encode, messages))
    framer, frames, at = Framer(), [], 0
    for piece in pieces:
        frames += framer.feed(data[at : at + piece])
        at += piece
    frames += framer.feed(data[at:])
    # A payload may itself hold a message; those a framer cannot tell apart before more bytes come.
    if not any(0xFA in m.payload or 0xFA in (m.mid, m.bid) or m.mid == 0 for m in messages):
        assert frames == messages
