"""Logs of the orientation sensor made of known samples, byte by byte as the sensor would send them."""

import numpy as np
from imu_messages import (
    Item,
    calibration_message,
    configuration_message,
    counts_of,
    items_payload,
    mtdata_payloads,
)
from scipy.spatial.transform import Rotation

from xsens.messages.contents import DataLayout, MessageId, OutputMode, RawCalibration
from xsens.messages.framing import Message, encode

G = 9.80665


def samples(m=200, rate_hz=100.0):
    """Slow turning about a tilted axis: what the sensor measures, and its orientation (NWU)."""
    rng = np.random.default_rng(0)
    time_s = np.arange(m) / rate_hz
    rate = np.array([0.3, -0.2, 0.5])
    world_from_sensor = Rotation.from_rotvec([0.2, -0.4, 1.0]) * Rotation.from_rotvec(np.outer(time_s, rate))
    sensor_from_world = world_from_sensor.inv()
    return {
        "time_s": time_s,
        "accelerometer_m_s2": sensor_from_world.apply([0.0, 0.0, G]) + rng.normal(0, 0.01, (m, 3)),
        "gyroscope_rad_s": rate + rng.normal(0, 0.01, (m, 3)),
        "magnetometer_au": sensor_from_world.apply([0.5, 0.0, -0.8]) + rng.normal(0, 0.005, (m, 3)),
        "world_from_sensor": world_from_sensor,
    }


def calibration(seed=0):
    """A calibration block like that of a real unit."""
    rng = np.random.default_rng(seed)
    return RawCalibration(
        rate_hz=256.0,
        offsets=rng.integers(29000, 34000, (3, 3)).astype(float),
        gains=np.round(np.array([[1270.0], [1250.0], [8000.0]]) * rng.uniform(0.9, 1.1, (3, 3)) * 256) / 256,
        misalignments=np.round((np.eye(3) + rng.normal(0, 0.01, (3, 3, 3))) * 2**14) / 2**14,
    )


def raw_values(s, unit, first=0):
    """Raw counts by field name; the counter begins at `first` and wraps round."""
    vectors = [s[name] for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")]
    counts = counts_of(unit, np.stack(vectors))
    m = len(counts)
    return {
        "counter": (first + np.arange(m)[:, None]) % 65536,
        "raw_accelerometer": counts[:, 0],
        "raw_gyroscope": counts[:, 1],
        "raw_magnetometer": counts[:, 2],
        "raw_temperature": np.full((m, 1), 31.25 * 256),
    }


def frame_payloads(payloads, mid=MessageId.MT_DATA):
    """Messages of one kind, a list so that tests can lose some."""
    return [encode(Message(mid, bytes(payload))) for payload in payloads]


def mt9_records(s, unit, first=0):
    """Records of an MT9-B."""
    return frame_payloads(mtdata_payloads(DataLayout(OutputMode.MT9), raw_values(s, unit, first)))


def mt9_bin(s, unit, first=0):
    """A file of the MT9 software: the block, the end of a record, records."""
    records = mt9_records(s, unit, first)
    return encode(calibration_message(unit)) + records[0][-15:] + b"".join(records)


def configuration(layout):
    """The answer to a request for the configuration."""
    return encode(configuration_message([(layout.mode, layout.settings)]))


def legacy_values(s, layout, first=0):
    """Everything a layout may ask for, by field name; orientation in the layout's world."""
    m = len(s["time_s"])
    rotation = s["world_from_sensor"]
    if layout.frame == "NED":
        rotation = Rotation.from_euler("x", np.pi) * rotation
    return {
        **{name: s[name] for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")},
        "temperature_c": np.full((m, 1), 31.25),
        "quaternion_wxyz": rotation.as_quat(scalar_first=True),
        "euler_deg": rotation.as_euler("xyz", degrees=True),
        "matrix": rotation.as_matrix().reshape(m, 9),
        "analog_1": np.full((m, 1), 17),
        "analog_2": np.full((m, 1), 18),
        "position": np.tile([52.25, 6.75, 30.5], (m, 1)),
        "velocity_m_s": np.zeros((m, 3)),
        "status": np.full((m, 1), 3),
        "counter": (first + np.arange(m)[:, None]) % 65536,
        "utc": np.tile(np.arange(12), (m, 1)),
    }


def legacy_messages(s, layout, first=0):
    """Messages of an MTi in legacy mode."""
    return frame_payloads(mtdata_payloads(layout, legacy_values(s, layout, first)))


WORLDS = {
    "ENU": Rotation.from_euler("z", np.pi / 2),
    "NED": Rotation.from_euler("x", np.pi),
    "NWU": Rotation.identity(),
}
"""World by name, ``world_from_nwu``."""


def items_of(s, i, form=0, world="ENU", orientation="quaternion", ticks=100, first_tick=0, first=0):
    """Items of sample `i`: counter, time, acceleration, rate, field, orientation."""
    rotation = WORLDS[world] * s["world_from_sensor"][i]
    bits = form | ("ENU", "NED", "NWU").index(world) << 2
    shape = {
        "quaternion": (0x2010, rotation.as_quat(scalar_first=True)),
        "matrix": (0x2020, rotation.as_matrix().T.ravel()),
        "euler": (0x2030, rotation.as_euler("xyz", degrees=True)),
    }[orientation]
    return [
        Item(0x1020, ((first + i) % 65536,)),
        Item(0x1060, ((first_tick + ticks * i) % 2**32,)),
        Item(0x4020 | form, tuple(s["accelerometer_m_s2"][i])),
        Item(0x8020 | form, tuple(s["gyroscope_rad_s"][i])),
        Item(0xC020 | form, tuple(s["magnetometer_au"][i])),
        Item(shape[0] | bits, tuple(shape[1])),
    ]


def mtdata2_messages(s, **how):
    """Messages of an MTi with MTData2."""
    payloads = [items_payload(items_of(s, i, **how)) for i in range(len(s["time_s"]))]
    return frame_payloads(payloads, MessageId.MT_DATA2)
