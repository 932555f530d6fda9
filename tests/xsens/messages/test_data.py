import numpy as np

from xsens.messages.contents import DataLayout, OutputMode, read_items
from xsens.messages.framing import find_frames


def test_a_record_of_a_real_mt9():
    frames = find_frames(bytes.fromhex("faff32168553716c8580ac7e7f4e7f377f26631489d776b0205040"))
    layout = DataLayout(OutputMode.MT9)
    values = {field.name: layout.decode(frames, field.name) for field in layout.fields}
    assert values["counter"] == 34131
    assert values["raw_accelerometer"].tolist() == [[29036, 34176, 44158]]
    assert values["raw_gyroscope"].tolist() == [[32590, 32567, 32550]]
    assert values["raw_magnetometer"].tolist() == [[25364, 35287, 30384]]
    assert values["raw_temperature"] / 256 == 32.3125


# Self-describing data


def test_a_packet_of_a_real_mti():
    data = "faff3626102002468210600401c4fc3e2010103f71ce6cbea56bcf3c613bd8bd691d25e020040040000312"
    values, world, is_sample, broken_data = read_items(find_frames(bytes.fromhex(data)))
    assert (sorted(values), world) == (["counter", "quaternion_wxyz", "ticks"], "ENU")
    assert (is_sample.all(), broken_data.any()) == (True, False)
    assert (values["counter"].item(), values["ticks"].item()) == (18050.0, 29686846.0)
    quaternion = [[0.944556, -0.323088, 0.013747, -0.056913]]
    np.testing.assert_allclose(values["quaternion_wxyz"], quaternion, atol=5e-7)
