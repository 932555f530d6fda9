"""Messages as a sensor would write them: the inverse of the package's decoders, for tests alone."""

import struct
from dataclasses import dataclass

import numpy as np

from xsens.messages.contents import KINDS, MessageId
from xsens.messages.framing import Message


def bytes_from_numbers(values, form):
    """Numbers, shape (n, k), to the nearest that the format of those two bits can hold, as rows of bytes."""
    array = np.asarray(values, dtype=np.float64)
    if form in (0, 3):
        with np.errstate(over="ignore", invalid="ignore"):  # to infinity, as the sensor's own would
            return np.ascontiguousarray(array.astype((">f4", "", "", ">f8")[form])).view(np.uint8)
    if form == 1:
        return np.ascontiguousarray(np.round(array * 2.0**20).astype(">i4")).view(np.uint8)
    ticks = np.round(array * 2.0**32)
    whole = np.ascontiguousarray(ticks.astype(">i8")[..., None]).view(np.uint8)
    return np.concatenate((whole[..., 4:], whole[..., 2:4]), axis=-1).reshape(*array.shape[:-1], -1)


def mtdata_payloads(layout, values):
    """Payloads of a `DataLayout` as rows of bytes, from values of shape (n, count) by field name."""
    parts = []
    for field in layout.fields:
        array = np.atleast_2d(np.asarray(values[field.name], dtype=float))
        assert array.shape[1] == field.count, field.name
        if field.whole:
            parts.append(np.ascontiguousarray(array.astype(field.whole)).view(np.uint8))
        else:
            parts.append(bytes_from_numbers(array, layout.settings >> 8 & 3))
    return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class Item:
    """One item of an MTData2 message: a tuple of numbers if the package reads it, else bytes."""

    identifier: int
    values: tuple[float, ...] | bytes


def items_payload(items):
    """Payload of an MTData2 message that holds `items`."""
    return b"".join(map(_item, items))


def _item(item):
    data = item.values
    if not isinstance(data, bytes):
        whole = KINDS[item.identifier].whole
        form = item.identifier & 3
        data = np.array(data).astype(whole).tobytes() if whole else bytes_from_numbers([data], form).tobytes()
    return struct.pack(">HB", item.identifier, len(data)) + data


def configuration_message(units, period=1152):
    """The answer to a request for the configuration, of units of some mode and settings."""
    payload = struct.pack(">IHH88xH", 0x1234, period, 0, len(units))
    for mode, settings in units:
        payload += struct.pack(">IHHI8x", 0x1234, 0, mode, settings)
    return Message(MessageId.CONFIGURATION, payload)


def calibration_message(unit):
    """The calibration block of an MT9-B; its housing square, what is not understood of it zero."""
    data = bytearray(168)
    struct.pack_into(">I", data, 0, 0x7154)
    struct.pack_into(">H", data, 81, round(115200 / unit.rate_hz))
    data[87:105] = np.round(unit.offsets).astype(">u2").tobytes()
    gains = np.round(unit.gains * 256).astype(">u4").reshape(9, 1).view(np.uint8)
    data[105:132] = gains[:, 1:].tobytes()
    for at, matrix in zip((8, 26, 132, 150), (*unit.misalignments, np.eye(3)), strict=True):
        data[at : at + 18] = np.round(matrix * 2**14).astype(">i2").tobytes()
    return Message(MessageId.EMTS, bytes(data))


def counts_of(unit, values):
    """Raw counts, shape (n, 3, 3), that the calibration takes to `values`, shape (3, n, 3)."""
    outputs = np.stack([values[i] @ unit.misalignments[i].T for i in range(3)], axis=1)
    return np.clip(np.round(outputs * unit.gains + unit.offsets), 0, 0xFFFF).astype(np.uint16)
