"""Write the inputs of this folder that are made: ``python tests/xsens/logs/corpus/make.py``."""

import struct
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[2]))

from imu_logs import calibration, configured, items_of, legacy_messages, mt9_bin, mtdata2_messages, samples  # noqa: E402
from imu_messages import Item, configuration_message, items_payload  # noqa: E402

from xsens.messages.control import MessageId  # noqa: E402
from xsens.messages.framing import Message, encode  # noqa: E402
from xsens.messages.mtdata import DataLayout  # noqa: E402


def of_items(*messages):
    return b"".join(encode(Message(MessageId.MT_DATA2, items_payload(items))) for items in messages)


def inputs():
    s = samples(8)
    calibrated = DataLayout(6, 0x201)
    signalling = struct.pack(">3I", 0x7F800001, 0x7FBFFFFF, 0xFF800001)
    bad_world = Item(0x201C, bytes(16))
    yield "mt9_truncated_record", mt9_bin(s, calibration(), first=65533)
    yield "legacy_fixed_point", configured(calibrated) + b"".join(legacy_messages(s, calibrated))
    yield "mtdata2_ned_euler", b"".join(mtdata2_messages(s, form=1, world="NED", orientation="euler"))
    yield "mid_message", b"".join(mtdata2_messages(s))[33:-21]
    yield "signalling_nan", of_items([Item(0x1020, (1,)), Item(0x1060, (5,)), Item(0x4020, signalling)])
    yield "world_not_known", of_items([Item(0x1020, (1,)), Item(0x1060, (5,)), bad_world])
    yield "clock_backwards", of_items(items_of(s, 5), items_of(s, 3), items_of(s, 3), items_of(s, 7))
    yield (
        "counter_without_clock",
        of_items(*([Item(0x1020, (i,)), Item(0x4020, (0.0, 0.0, 9.8))] for i in (1, 9))),
    )
    yield (
        "units_of_impossible_size",
        encode(configuration_message([(2, 1)] * 3, 0, 0xFFFF, 0xFFFF)) + bytes(40),
    )
    yield "settings_not_known", configured(calibrated)[:-20] + b"\xff" * 40
    yield "calibration_of_zeros", encode(Message(0x91, bytes(168))) + mt9_bin(s, calibration())[173:]
    yield "calibration_too_long", encode(Message(0x91, bytes(1320))) + mt9_bin(s, calibration())[173:]
    yield "hostile_lengths", bytes.fromhex("faff32ffffff") * 50 + bytes.fromhex("faff32ff2000") * 50
    yield "message_in_message", encode(Message(0x32, encode(Message(0x32, encode(Message(0x32, bytes(22)))))))
    yield "time_of_no_calendar", encode(Message(0x61, b"\xff" * 12)) + mt9_bin(s, calibration())
    yield "text_with_a_control", b"time_s,acc_x,acc_y,acc_z\n" + b"0.1,0,0,9.8\n" * 20 + b"0.2,\x000,0,9.8\n"
    yield "text_of_half_words", b"\xff\xfe" + "1\t2\t3\t4\n".encode("utf-16-le")[:-1]
    yield "text_of_infinite_rate", b"// Update Rate: 0.0.0Hz\ncounter,acc_x,acc_y,acc_z\n1,0,0,9.8\n"
    yield (
        "text_of_gaps",
        b"# gaps: 9\n# gap: after sample 99, 9 lost, x s\ntime_s,acc_x,acc_y,acc_z\n0,0,0,9.8\n",
    )
    yield "text_of_large_counter", b"counter,sampletimefine,acc_x,acc_y,acc_z\n" + b"9e15,9e15,0,0,9.8\n" * 3


if __name__ == "__main__":
    for name, data in inputs():
        (HERE / f"{name}.bin").write_bytes(data)
