import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from imu_messages import mtdata_payloads

from xsens.messages.framing import decode, find_frames
from xsens.messages.mtdata import DataLayout, OutputMode
from xsens.messages.mtdata2 import read_items

FEW = settings(deadline=None, max_examples=60)


def rows(data):
    return np.frombuffer(bytes.fromhex(data), dtype=np.uint8)[None]


# Number formats


# Legacy data


def test_a_record_of_a_real_mt9():
    (message,) = decode(bytes.fromhex("faff32168553716c8580ac7e7f4e7f377f26631489d776b0205040"))
    values = DataLayout(OutputMode.MT9).decode(rows(message.payload.hex()))
    assert values["counter"] == 34131
    assert values["raw_accelerometer"].tolist() == [[29036, 34176, 44158]]
    assert values["raw_gyroscope"].tolist() == [[32590, 32567, 32550]]
    assert values["raw_magnetometer"].tolist() == [[25364, 35287, 30384]]
    assert values["raw_temperature"] / 256 == 32.3125


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


# Self-describing data


def test_a_packet_of_a_real_mti():
    data = "faff3626102002468210600401c4fc3e2010103f71ce6cbea56bcf3c613bd8bd691d25e020040040000312"
    values, world, measured, damaged = read_items(find_frames(bytes.fromhex(data)))
    assert (sorted(values), world) == (["packet_counter", "quaternion_wxyz", "sample_time_fine"], "ENU")
    assert (measured.all(), damaged.any()) == (True, False)
    assert (values["packet_counter"].item(), values["sample_time_fine"].item()) == (18050.0, 29686846.0)
    quaternion = [[0.944556, -0.323088, 0.013747, -0.056913]]
    np.testing.assert_allclose(values["quaternion_wxyz"], quaternion, atol=5e-7)
