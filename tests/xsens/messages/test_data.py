import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from imu_messages import bytes_from_numbers, items_payload, mtdata_payloads

from speckle3d.core.errors import InvalidInputError, MismatchError
from xsens.messages.control import MessageId
from xsens.messages.framing import Message, decode, encode, find_frames
from xsens.messages.mtdata import DataLayout, NumberFormat, OutputMode, OutputSettings, numbers_from_bytes
from xsens.messages.mtdata2 import (
    KINDS,
    Item,
    columns,
    decode_items,
    kind_of,
    number_format,
    size_of,
    world_of,
)

FEW = settings(deadline=None, max_examples=60)
FORMATS = list(NumberFormat)


def rows(data):
    return np.frombuffer(bytes.fromhex(data), dtype=np.uint8)[None]


# Number formats


def test_fixed_point_numbers_of_a_real_packet():
    """Latitude of a recording, in both formats, and a negative one whose fraction comes first."""
    np.testing.assert_allclose(
        numbers_from_bytes(rows("039adf03"), NumberFormat.FP12_20), 57.67944622, 0, 1e-8
    )
    two = numbers_from_bytes(rows("adf052980039f63fcaf0ffff"), NumberFormat.FP16_32)
    np.testing.assert_allclose(two, [[57.67944828, -0.03808910]], 0, 5e-9)


def in_range(form):
    limit = {NumberFormat.FP12_20: 2047.0, NumberFormat.FP16_32: 32767.0}.get(form)
    return st.floats(-limit, limit) if limit else st.floats(width=32 if form is NumberFormat.FLOAT32 else 64)


@FEW
@given(st.data(), st.sampled_from(FORMATS))
def test_numbers_come_back_to_half_the_last_bit(data, form):
    values = np.array([data.draw(st.lists(in_range(form), min_size=3, max_size=3))])
    packed = bytes_from_numbers(values, form)
    assert packed.shape == (1, 3 * form.size)
    step = {NumberFormat.FP12_20: 2.0**-21, NumberFormat.FP16_32: 2.0**-33}.get(form, 0.0)
    np.testing.assert_allclose(numbers_from_bytes(packed, form), values, rtol=0, atol=step)


@FEW
@given(st.binary(min_size=24, max_size=24), st.sampled_from(FORMATS))
def test_bytes_of_numbers_come_back(data, form):
    packed = np.frombuffer(data, dtype=np.uint8)[None, : 24 // form.size * form.size]
    values = numbers_from_bytes(packed, form)
    again = bytes_from_numbers(np.nan_to_num(values, nan=0.5, posinf=0.5, neginf=-0.5), form)
    whole = np.isfinite(values).repeat(form.size, axis=1)
    assert (again == packed)[whole].all()


# Legacy data


def test_a_record_of_a_real_mt9():
    (message,) = decode(bytes.fromhex("faff32168553716c8580ac7e7f4e7f377f26631489d776b0205040"))
    values = DataLayout(OutputMode.MT9).decode(message.payload)
    assert values["counter"] == 34131
    assert values["raw_accelerometer"].tolist() == [[29036, 34176, 44158]]
    assert values["raw_gyroscope"].tolist() == [[32590, 32567, 32550]]
    assert values["raw_magnetometer"].tolist() == [[25364, 35287, 30384]]
    assert values["raw_temperature"] / 256 == 32.3125


def test_a_quaternion_with_its_counter_last():
    (message,) = decode(bytes.fromhex("faff32123f000000bf0000003f0000003f00000001023e"))
    values = DataLayout(OutputMode.ORIENTATION, OutputSettings.COUNTER).decode(message.payload)
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
@given(modes, settings_, st.booleans(), st.integers(0, 2**32 - 1))
def test_every_mode_and_manner_comes_back(mode, manner, counter_first, seed):
    layout = DataLayout(mode, manner, counter_first)
    rng = np.random.default_rng(seed)
    values = {}
    for field in layout.fields:
        real = field.kind == "real"
        most = 1000 if real else np.iinfo(field.kind).max
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
    assert DataLayout(OutputMode.ORIENTATION, OutputSettings.EULER | OutputSettings.FP16_32).size == 18
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


def test_a_payload_of_another_length_is_refused():
    layout = DataLayout(OutputMode.ORIENTATION, OutputSettings.COUNTER)
    with pytest.raises(MismatchError, match=r"18 .*17"):
        layout.decode(bytes(17))


# Self-describing data


def test_a_packet_of_a_real_mti():
    data = "faff3626102002468210600401c4fc3e2010103f71ce6cbea56bcf3c613bd8bd691d25e020040040000312"
    (message,) = decode(bytes.fromhex(data))
    items = {item.name: item.values for item in decode_items(message.payload)}
    assert items["packet_counter"] == (18050,)
    assert items["sample_time_fine"] == (29686846,)
    assert items["status_word"] == (0x00400003,)
    np.testing.assert_allclose(
        items["quaternion_wxyz"], (0.944556, -0.323088, 0.013747, -0.056913), atol=5e-7
    )


whole_numbers = {"B": (0, 255), "b": (-128, 127), "H": (0, 2**16 - 1), "h": (-(2**15), 2**15 - 1)}
whole_numbers |= {"I": (0, 2**32 - 1), "i": (-(2**31), 2**31 - 1), "Q": (0, 2**64 - 1)}


@st.composite
def items(draw):
    identifier = draw(st.sampled_from(sorted(KINDS)))
    kind = KINDS[identifier]
    if kind.reals:
        form = draw(st.sampled_from(FORMATS))
        identifier |= form | draw(st.integers(0, 2)) << 2
        values = draw(st.lists(in_range(form), min_size=kind.reals, max_size=kind.reals))
        exact = numbers_from_bytes(bytes_from_numbers([values], form), form)[0]
        return Item(identifier, tuple(np.nan_to_num(exact, posinf=1.0, neginf=-1.0).tolist()))
    if kind.whole:
        repeated = 10 if kind.whole[1:3] == "10" else 3 if kind.whole[1] == "3" else 1
        codes = kind.whole[1:].lstrip("0123456789") * repeated
        return Item(identifier, tuple(draw(st.integers(*whole_numbers[code])) for code in codes))
    return Item(identifier, draw(st.binary(max_size=40)))


@settings(deadline=None, max_examples=150)
@given(st.lists(items(), max_size=8))
def test_every_kind_of_item_comes_back(sent):
    payload = items_payload(sent)
    assert decode_items(payload) == sent
    assert items_payload(decode_items(payload)) == payload


def test_every_identifier_has_a_name_of_its_own_and_reals_come_in_all_formats_and_worlds():
    names = [kind.name for kind in KINDS.values()]
    assert len(set(names)) == len(names)
    for identifier, kind in KINDS.items():
        for bits in range(16):
            world = bits >> 2
            known = kind_of(identifier | bits)
            assert (known is kind) or bits or (not kind.reals or world == 3)
            if kind.reals and world < 3:
                assert known is kind
                assert size_of(identifier | bits) == kind.reals * (4, 4, 6, 8)[bits & 3]
                assert number_format(identifier | bits) == bits & 3
    assert [world_of(0x2010 | bits) for bits in (0, 4, 8)] == ["ENU", "NED", "NWU"]
    with pytest.raises(InvalidInputError, match=r"0x201c.*3"):
        world_of(0x201C)


@FEW
@given(st.integers(0, 65535), st.binary(max_size=255))
def test_items_not_known_or_of_another_size_are_kept_as_bytes(identifier, data):
    payload = items_payload([Item(identifier, data)])
    (item,) = decode_items(payload)
    assert item.identifier == identifier
    if size_of(identifier) != len(data):
        assert item.values == data
    if kind_of(identifier) is None:
        assert item.name == f"{identifier:#06x}"
    if isinstance(item.values, bytes):
        assert items_payload([item]) == payload


@pytest.mark.parametrize("cut", [1, 2, 4, 6, 8, 19])
def test_items_that_claim_more_than_is_there_are_refused(cut):
    payload = items_payload([Item(0x1020, (7,)), Item(0x4020, (1.0, 2.0, 3.0))])
    with pytest.raises(InvalidInputError):
        decode_items(payload[:cut])


# Many messages at once


def mixed(count, seed=0):
    """Messages of changing arrangement and format, as an MTi sends whose items have different rates."""
    rng = np.random.default_rng(seed)
    sent = []
    for i in range(count):
        form = int(rng.integers(4))
        items = [Item(0x1020, (i,)), Item(0x4020 | form, tuple(np.round(rng.normal(size=3) * 64) / 64))]
        if i % 4 == 0:
            items.append(Item(0xC020, tuple(np.round(rng.normal(size=3) * 64) / 64)))
        if i % 7 == 0:
            items.insert(1, Item(0x7777, bytes(int(rng.integers(200)))))
        sent.append(items)
    return sent


@pytest.mark.parametrize("most", [1, 32])
def test_columns_are_what_each_message_says_by_itself(monkeypatch, most):
    monkeypatch.setattr("xsens.messages.mtdata2._MOST_ARRANGEMENTS", most)
    sent = mixed(300)
    data = b"".join(encode(Message(MessageId.MT_DATA2, items_payload(items))) for items in sent)
    wanted = frozenset({"acceleration_m_s2", "magnetic_field_au", "packet_counter"})
    table, damaged = columns(find_frames(data), wanted)
    assert damaged == 0
    for identifier, column in table.items():
        expected = [(row, i.values) for row, m in enumerate(sent) for i in m if i.identifier == identifier]
        assert column.rows.tolist() == [row for row, _ in expected]
        assert column.values.tolist() == [list(values) for _, values in expected]
    assert {i for m in sent for item in m if (i := item.identifier) != 0x7777} == set(table)


def test_columns_count_messages_that_cannot_be_taken_apart():
    good = items_payload([Item(0x4020, (1.0, 2.0, 3.0))])
    payloads = [good, good[:-1], b"\x10", good, b""]
    data = b"".join(encode(Message(MessageId.MT_DATA2, p)) for p in payloads)
    table, damaged = columns(find_frames(data), frozenset({"acceleration_m_s2"}))
    assert damaged == 2
    assert table[0x4020].rows.tolist() == [0, 3]
