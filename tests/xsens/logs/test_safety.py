"""Readers survive whatever a file holds: samples or one line of error, in bounded time and memory.

``corpus/`` keeps inputs worth trying again: each reaches a part of the readers that no other does, or once
broke one. ``corpus/make.py`` writes those that are made; add by hand what is found.
"""

import os
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from imu_logs import calibration, configured, legacy_messages, mt9_bin, mtdata2_messages, samples
from imu_messages import Item, items_payload

from speckle3d.core.errors import FileError, Speckle3DError
from xsens.logs.read import MOST_BYTES, parse_stream, read_log
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import parse_text
from xsens.messages.control import Configuration, MessageId
from xsens.messages.framing import Framer, Message, encode, find_frames
from xsens.messages.mtdata import DataLayout, OutputMode, OutputSettings
from xsens.messages.rawcounts import RawCalibration

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.bin"))
assert CORPUS, "the corpus lies beside this file"
SECONDS = float(os.environ.get("FUZZ_SECONDS", "4"))
"""For each kind of input, at most, in the slow tests; ``FUZZ_SECONDS=600`` makes it ten minutes each."""

PER_SECOND = 75
"""Inputs tried in a second, about."""


def outcome(read, data):
    """What a reader returns, or its error."""
    try:
        return read(data)
    except Speckle3DError as error:
        return error


def assert_one_line(error):
    assert str(error)
    assert "\n" not in str(error)
    assert len(str(error)) < 500


def survives(data, tmp_path=None):
    """Samples that are valid, or None after one line of error; nothing else, and no warning."""
    if tmp_path is None:
        log = outcome(parse_stream, data)
    else:
        (tmp_path / "log").write_bytes(data)
        log = outcome(read_log, tmp_path / "log")
    if isinstance(log, Speckle3DError):
        assert_one_line(log)
        return None
    assert isinstance(log, ImuLog)
    assert (np.diff(log.time_s) > 0).all()
    for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"):
        vectors = getattr(log, name)
        assert vectors is None or (np.isnan(vectors) | (np.abs(vectors) < 1e6)).all()
    return log


def streams():
    s = samples(8)
    layout = DataLayout(
        OutputMode.CALIBRATED | OutputMode.ORIENTATION | OutputMode.STATUS,
        OutputSettings.COUNTER | OutputSettings.MATRIX,
    )
    return {
        "mt9": mt9_bin(s, calibration()),
        "legacy": configured(layout) + b"".join(legacy_messages(s, layout)),
        "mtdata2": b"".join(mtdata2_messages(s, form=2)),
    }


STREAMS = streams()


@pytest.mark.parametrize("kind", STREAMS)
def test_truncation_at_every_offset_loses_what_is_cut_and_no_more(kind):
    data = STREAMS[kind]
    whole = find_frames(data)
    for cut in range(len(data)):
        left = find_frames(data[:cut])
        np.testing.assert_array_equal(left.end, whole.end[whole.end <= cut])
        survives(data[:cut])


@pytest.mark.parametrize("kind", STREAMS)
def test_every_single_bit_flipped_costs_one_message_at_most(kind):
    data = STREAMS[kind]
    whole = set(find_frames(data).messages())
    rng = np.random.default_rng(0)
    for bit in rng.choice(8 * len(data), 400, replace=False):
        spoiled = bytearray(data)
        spoiled[bit // 8] ^= 1 << bit % 8
        survives(bytes(spoiled))
        kept = set(find_frames(bytes(spoiled)).messages())
        assert len(whole - kept) <= 1, bit


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_the_corpus_is_survived(path, tmp_path):
    data = path.read_bytes()
    survives(data, tmp_path)
    survives(data)
    assert sum(p.stat().st_size for p in CORPUS) < 200_000


def fuzzed(seconds):
    """A clock that says whether there is time left, and Hypothesis's settings for so long."""
    begin = time.monotonic()
    examples = int(PER_SECOND * seconds)
    limits = settings(deadline=None, max_examples=examples, suppress_health_check=list(HealthCheck))
    return (lambda: time.monotonic() - begin < seconds), limits


@st.composite
def damaged(draw, originals):
    """A log with pieces cut, doubled, overwritten and flipped."""
    data = bytearray(draw(st.sampled_from(originals)))
    for _ in range(draw(st.integers(0, 6))):
        at = draw(st.integers(0, len(data)))
        size = draw(st.integers(0, 60))
        how = draw(st.sampled_from(["cut", "double", "overwrite", "insert"]))
        if how == "cut":
            del data[at : at + size]
        elif how == "double":
            data[at:at] = data[at : at + size]
        elif how == "overwrite":
            new = draw(st.binary(max_size=size))
            data[at : at + len(new)] = new
        else:
            data[at:at] = draw(
                st.sampled_from([b"\xfa", b"\xfa\xff\x32\xff\x1f\xff", b"\xff", b"\t", b"\n", b","])
            )
    return bytes(data)


@st.composite
def resealed(draw):
    """Messages with holding checksums and any content: what damage leaves whole and what malice writes."""
    mids = st.sampled_from([0x32, 0x36, 0x0D, 0x91, 0x61, 0x3E, 0x11])
    items = st.builds(
        Item,
        st.sampled_from(
            [0x1020, 0x1060, 0x4020, 0x4022, 0x8020, 0xC020, 0x2010, 0x2020, 0x2030, 0x201C, 0x8030]
        ),
        st.sampled_from([2, 4, 12, 16, 18, 24, 36]).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
    )
    payload = st.one_of(
        st.binary(max_size=200),
        st.binary(min_size=22, max_size=22),
        st.binary(min_size=168, max_size=168),
        st.lists(items, max_size=6).map(items_payload),
    )
    messages = draw(st.lists(st.builds(Message, mids, payload, st.just(0xFF)), max_size=12))
    return b"".join(map(encode, messages))


TEXTS = [
    b"PacketCounter\tAcc_X\tAcc_Y\tAcc_Z\tMat[1][1]\n00472\t\t0.1\t4.8\t-8.5\n00473\t1\t2\t3\t4\n",
    b"time_s,counter,acc_x,acc_y,acc_z\n0,1,0,0,9.8\n0.1,2,0,0,9.8\n",
    b"sep=,\nDeviceTag:,x\nOutputRate:,60Hz\nPacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z\n1,5,1,0,0,0\n",
    b"0.0\t1.0\t2.0\t3.0\n0.1\t1.0\t2.0\t3.0\n",
]


@pytest.mark.parametrize("seconds", [0.5, pytest.param(SECONDS, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "inputs",
    [
        st.binary(max_size=600),
        damaged(list(STREAMS.values())),
        damaged(TEXTS),
        resealed(),
        st.text(alphabet='0123456789.,;\t\n -eE#naif"', max_size=300).map(str.encode),
    ],
    ids=["bytes", "damaged logs", "damaged text", "resealed messages", "numbers"],
)
def test_fuzzed(inputs, seconds, tmp_path):
    in_time, limits = fuzzed(seconds)

    @limits
    @given(inputs)
    @example(b"")
    def run(data):
        if in_time():
            survives(data, tmp_path)

    run()


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=300))
def test_decoders_of_single_messages_refuse_with_one_line(data):
    readers = (
        lambda b: Configuration.from_message(Message(MessageId.CONFIGURATION, b)),
        lambda b: RawCalibration.from_message(Message(MessageId.EMTS, b[:168].ljust(168, b"\x01"))),
        lambda b: DataLayout(int.from_bytes(b[:2], "big"), int.from_bytes(b[2:6], "big")).size,
        lambda b: parse_text(b.decode("utf-8", "replace")),
    )
    for reader in readers:
        found = outcome(reader, data)
        if isinstance(found, Speckle3DError):
            assert_one_line(found)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.binary(max_size=200), max_size=30))
def test_a_framer_holds_no_more_than_one_longest_message(pieces):
    framer = Framer()
    for piece in pieces:
        framer.feed(b"\xfa\xff\x32\xff\x20\x00" + piece)
        assert len(framer._rest) <= 8192 + 7


# Files that are no logs, or too large


def test_a_file_that_claims_ten_gigabytes_is_refused_unread(tmp_path):
    path = tmp_path / "large.bin"
    with path.open("wb") as file:
        file.truncate(10 * 1024**3)
    tracemalloc.start()
    try:
        with pytest.raises(FileError, match=f"{MOST_BYTES}.*10737418240"):
            read_log(path)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


def test_what_is_no_file_is_refused_at_once(tmp_path):
    with pytest.raises(FileError, match=r"missing.bin.*No such file"):
        read_log(tmp_path / "missing.bin")
    with pytest.raises(FileError, match="Is a directory"):
        read_log(tmp_path)
    with pytest.raises(FileError, match="null byte"):
        read_log("a\0b")
    (tmp_path / "empty.bin").write_bytes(b"")
    with pytest.raises(Speckle3DError, match=r"empty.bin.*empty"):
        read_log(tmp_path / "empty.bin")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_and_devices_are_neither_waited_for_nor_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(FileError, match=str(path)):
            read_log(path)


# Time and memory


SIZE = 200_000


def repeated(piece):
    return piece * (SIZE // len(piece))


def many_arrangements():
    rng = np.random.default_rng(0)
    identifiers, sizes = (0x4020, 0x8020, 0xC020, 0x1020, 0x1060, 0x2010, 0x7777), (12, 2, 4, 16, 24)
    pieces = []
    for _ in range(SIZE // 50):
        drawn = zip(rng.choice(identifiers, 3), rng.choice(sizes, 3), strict=True)
        pieces.append(encode(Message(0x36, items_payload(Item(int(i), bytes(int(n))) for i, n in drawn))))
    return b"".join(pieces)


HOSTILE = {
    "preambles": repeated(b"\xfa"),
    "nested lengths": repeated(bytes.fromhex("faff32ff1fff")),
    "empty messages": repeated(encode(Message(0x36))),
    "broken items": repeated(encode(Message(0x36, b"\x10\x20\xff"))),
    "many arrangements": many_arrangements(),
    "new starts": repeated(encode(Message(0x61, bytes(12))) + encode(Message(0x32, bytes(22)))),
    "configurations": repeated(encode(Message(0x0D, bytes(96) + b"\xff\xff"))),
    "noise": np.random.default_rng(1).integers(0, 256, SIZE, np.uint8).tobytes(),
    "zeros": bytes(SIZE),
    "tabs": b"time_s\tcounter\n" + repeated(b"\t\n"),
    "one long number": repeated(b"1"),
    "one long line": b"time_s,counter" + repeated(b","),
    "wide": b"time_s,counter" + b"," * 250 + b"\n" + repeated(b"," * 251 + b"\n"),
    "uneven lines": b"time_s,counter,acc_x,acc_y,acc_z\n" + repeated(b"1,2,3,4,5\n1,2\n"),
    "words": b"time_s,counter,acc_x,acc_y,acc_z\n" + repeated(b"a,b,c,d,e\n"),
    "words beside numbers": b"time_s,counter,acc_x,acc_y,acc_z\n" + repeated(b"1,2,c,d,e\n"),
    "comments": repeated(b"#\n"),
    "huge numbers": b"time_s,counter,acc_x,acc_y,acc_z\n" + repeated(b"1e308,1e300,1e999,nan,-inf\n"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_time_and_memory_grow_with_the_size_alone(name, tmp_path):
    """Twice the memory of the worst of them, 35 times the size. Time is guarded, not measured: the worst
    takes 0.1 s, one that went back to its start at every byte would take hours."""
    data = HOSTILE[name]
    begin = time.process_time()
    survives(data, tmp_path)
    assert time.process_time() - begin < 30.0
    tracemalloc.start()
    try:
        survives(data, tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 70 * len(data)
    finally:
        tracemalloc.stop()
