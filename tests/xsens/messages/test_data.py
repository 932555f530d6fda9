from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from imu_messages import Item, bytes_from_numbers, items_payload, mtdata_payloads

from speckle3d.core.errors import InvalidInputError
from xsens.messages.control import MessageId
from xsens.messages.framing import Message, decode, encode, find_frames
from xsens.messages.mtdata import REAL, DataLayout, OutputMode, OutputSettings, as_floats
from xsens.messages.mtdata2 import KINDS, columns, kind_of, world_of

FEW = settings(deadline=None, max_examples=60)


def rows(data):
    return np.frombuffer(bytes.fromhex(data), dtype=np.uint8)[None]


# Number formats


def test_fixed_point_numbers_of_a_real_packet():
    """Latitude of a recording, in both formats, and a negative one whose fraction comes first."""
    np.testing.assert_allclose(as_floats(rows("039adf03").view(REAL[1])), 57.67944622, 0, 1e-8)
    two = as_floats(rows("adf052980039f63fcaf0ffff").view(REAL[2]))
    np.testing.assert_allclose(two, [[57.67944828, -0.03808910]], 0, 5e-9)


@FEW
@given(st.binary(min_size=24, max_size=24), st.integers(0, 3))
def test_bytes_of_numbers_come_back(data, form):
    packed = np.frombuffer(data, dtype=np.uint8)[None]
    values = as_floats(packed.view(REAL[form]))
    again = bytes_from_numbers(np.nan_to_num(values, nan=0.5, posinf=0.5, neginf=-0.5), form)
    whole = np.isfinite(values).repeat(np.dtype(REAL[form]).itemsize, axis=1)
    assert (again == packed)[whole].all()


# Legacy data


def test_a_record_of_a_real_mt9():
    (message,) = decode(bytes.fromhex("faff32168553716c8580ac7e7f4e7f377f26631489d776b0205040"))
    values = DataLayout(OutputMode.MT9).decode(rows(message.payload.hex()))
    assert values["counter"] == 34131
    assert values["raw_accelerometer"].tolist() == [[29036, 34176, 44158]]
    assert values["raw_gyroscope"].tolist() == [[32590, 32567, 32550]]
    assert values["raw_magnetometer"].tolist() == [[25364, 35287, 30384]]
    assert values["raw_temperature"] / 256 == 32.3125


def test_a_quaternion_with_its_counter_last():
    (message,) = decode(bytes.fromhex("faff32123f000000bf0000003f0000003f00000001023e"))
    values = DataLayout(OutputMode.ORIENTATION, OutputSettings.COUNTER).decode(rows(message.payload.hex()))
    assert values["quaternion_wxyz"].tolist() == [[0.5, -0.5, 0.5, 0.5]]
    assert values["counter"] == 258


PARTS = [
    OutputMode.TEMPERATURE,
    OutputMode.CALIBRATED,
    OutputMode.ORIENTATION,
    OutputMode.AUXILIARY,
    OutputMode.POSITION,
    OutputMode.VELOCITY,
    OutputMode.STATUS,
]

modes = st.one_of(
    st.sampled_from([OutputMode.RAW, OutputMode.MT9]),
    st.sets(st.sampled_from(PARTS), min_size=1).map(sum),
)
settings_ = st.builds(
    lambda low, shape, off, form, analog, ned: (
        low | shape << 2 | off << 4 | form << 8 | analog << 10 | ned << 31
    ),
    st.integers(0, 3),
    st.integers(0, 2),
    st.integers(0, 6),
    st.integers(0, 3),
    st.integers(0, 2),
    st.integers(0, 1),
)


@settings(deadline=None, max_examples=150)
@given(modes, settings_, st.integers(0, 2**32 - 1))
def test_every_mode_and_manner_comes_back(mode, manner, seed):
    layout = DataLayout(mode, manner)
    rng = np.random.default_rng(seed)
    values = {}
    for field in layout.fields:
        real = not field.whole
        most = 1000 if real else np.iinfo(field.whole).max
        drawn = (
            rng.uniform(-most, most, (4, field.count)) if real else rng.integers(0, most, (4, field.count))
        )
        values[field.name] = drawn
    payloads = mtdata_payloads(layout, values)
    assert payloads.shape == (4, layout.size)
    back = layout.decode(payloads)
    for name, sent in values.items():
        # Half a bit of FP12.20, the coarsest at this size but float32's 24 bits.
        np.testing.assert_allclose(back[name], sent, rtol=2**-24, atol=2**-21)
    assert (mtdata_payloads(layout, back) == payloads).all()


def test_sizes_of_legacy_data():
    """The vendor's table: 12 bytes a vector, 36 a matrix, 20 raw counts, 2 a counter, 4 a temperature."""
    assert DataLayout(OutputMode.CALIBRATED, OutputSettings.COUNTER).size == 38
    assert DataLayout(OutputMode.CALIBRATED, OutputSettings.NO_MAGNETOMETER).size == 24
    assert DataLayout(OutputMode.ORIENTATION, OutputSettings.MATRIX).size == 36
    assert DataLayout(OutputMode.ORIENTATION, 0x4 | 0x200).size == 18
    assert DataLayout(OutputMode.RAW, OutputSettings.COUNTER).size == 22
    assert DataLayout(OutputMode.TEMPERATURE | OutputMode.STATUS, OutputSettings.UTC).size == 4 + 1 + 12


def test_modes_that_cannot_be_are_refused():
    for mode in (0, OutputMode.RAW | OutputMode.CALIBRATED, 0x0040):
        with pytest.raises(InvalidInputError, match=f"mode.*{mode:#06x}"):
            DataLayout(mode)
    with pytest.raises(InvalidInputError, match="0xc"):
        DataLayout(OutputMode.ORIENTATION, 0xC)
    with pytest.raises(InvalidInputError, match="0x70"):
        DataLayout(OutputMode.CALIBRATED, 0x70)


# Self-describing data


def test_a_packet_of_a_real_mti():
    data = "faff3626102002468210600401c4fc3e2010103f71ce6cbea56bcf3c613bd8bd691d25e020040040000312"
    table, damaged = columns(find_frames(bytes.fromhex(data)))
    assert (sorted(table), damaged) == ([0x1020, 0x1060, 0x2010], 0)
    assert table[0x1020].values.tolist() == [[18050.0]]
    assert table[0x1060].values.tolist() == [[29686846.0]]
    quaternion = [[0.944556, -0.323088, 0.013747, -0.056913]]
    np.testing.assert_allclose(table[0x2010].values, quaternion, atol=5e-7)


def test_orientations_name_their_world():
    assert [world_of(0x2010 | bits) for bits in (0, 4, 8)] == ["ENU", "NED", "NWU"]
    assert kind_of(0x201C) is None


def mixed(count, seed=0):
    """Messages of changing arrangement, formats and worlds, as an MTi sends whose items have different rates.

    Items that are not known, or of another size than they should have, lie between the others.
    """
    rng = np.random.default_rng(seed)
    sent = []
    for i in range(count):
        items = [Item(0x1020, (i,))]
        for identifier, kind in KINDS.items():
            if rng.random() < 0.3 and not kind.whole:
                bits = int(rng.integers(4) | rng.integers(3) << 2)
                items.append(Item(identifier | bits, tuple(np.round(rng.normal(size=kind.count) * 64) / 64)))
        for odd in (0x7777, 0x201C, 0x4040, 0x4020, 0x1060):
            if rng.random() < 0.1:
                items.insert(int(rng.integers(len(items))), Item(odd, bytes(int(rng.integers(13, 200)))))
        sent.append(items)
    return sent


def test_columns_are_what_was_sent():
    sent = mixed(300)
    data = b"".join(encode(Message(MessageId.MT_DATA2, items_payload(items))) for items in sent)
    table, damaged = columns(find_frames(data))
    assert damaged == 0
    expected = defaultdict(list)
    for row, items in enumerate(sent):
        for item in items:
            if not isinstance(item.values, bytes):
                expected[item.identifier].append((row, list(item.values)))
    assert len(expected) > 90
    got = {i: list(zip(c.rows.tolist(), c.values.tolist(), strict=True)) for i, c in table.items()}
    assert got == expected


def test_columns_count_messages_that_cannot_be_taken_apart():
    good = items_payload([Item(0x1020, (7,)), Item(0x4020, (1.0, 2.0, 3.0))])
    payloads = [good, *(good[:cut] for cut in (1, 2, 4, 6, 8, 19)), good, b""]
    data = b"".join(encode(Message(MessageId.MT_DATA2, p)) for p in payloads)
    table, damaged = columns(find_frames(data))
    assert damaged == 6
    assert table[0x4020].rows.tolist() == [0, 7]
