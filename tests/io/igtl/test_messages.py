"""Our messages against pyigtl's, and what cannot be a message."""

import struct
import warnings

import igtl_examples
import numpy as np
import pyigtl
import pytest
from fastcrc.crc64 import ecma_182
from igtl_examples import CRC64
from pyigtl.messages import MessageBase

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.igtl.messages import (
    ImageReceived,
    Limits,
    MessageError,
    Other,
    StatusReceived,
    TextReceived,
    TransformReceived,
    decode,
    packed_image,
    packed_status,
    packed_text,
    packed_transform,
)


def decoded(message, limits=None):
    return decode(message[:58], message[58:], limits)


def by_pyigtl(message):
    fields = MessageBase.parse_header(message[:58])
    found = MessageBase.create_message(fields["message_type"])
    found.unpack(fields, message[58:])
    return found


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, "f4", "f8"])
@pytest.mark.parametrize("version", [1, 2])
def test_an_image_of_pyigtl_is_read(dtype, version):
    message, pixels, place = igtl_examples.image(dtype=dtype, version=version)
    found = decoded(message)
    assert isinstance(found, ImageReceived)
    assert (found.device, found.time_s, found.components) == ("Image_Reference", 12.25, 1)
    assert found.pixels.dtype == dtype
    np.testing.assert_array_equal(found.pixels, pixels)
    # 1e-6: places are single precision in messages.
    np.testing.assert_allclose(found.image_to_world, place, atol=1e-6)
    np.testing.assert_allclose(found.spacing_mm, [0.3, 0.1, 2.0], atol=1e-6)


def test_an_image_in_lps_is_turned_into_ras():
    message, pixels, place = igtl_examples.image(world="lps")
    found = decoded(message)
    np.testing.assert_array_equal(found.pixels, pixels)
    np.testing.assert_allclose(found.image_to_world, np.diag([-1, -1, 1, 1]) @ place, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
@pytest.mark.parametrize("shape", [(6, 9), (6, 9, 4)])
def test_pyigtl_and_we_read_an_image_of_ours(dtype, shape):
    pixels = np.random.default_rng(0).integers(0, 100, shape).astype(dtype)
    place = np.array([[0.0, 0, 2, 1], [0.3, 0, 0, 2], [0, 0.1, 0, 3], [0, 0, 0, 1]])
    message = packed_image("Volume", 1700000000.123456, pixels, place)
    theirs, ours = by_pyigtl(message), decoded(message)
    np.testing.assert_array_equal(theirs.image, np.atleast_3d(pixels).transpose(2, 1, 0))
    assert theirs.world_coordinate_system == "ras"
    np.testing.assert_array_equal(ours.pixels, pixels)
    for each, matrix in ((theirs, theirs.ijk_to_world_matrix), (ours, ours.image_to_world)):
        np.testing.assert_allclose(matrix, place, atol=1e-5)
        time_s = each.timestamp if each is theirs else each.time_s
        assert time_s == pytest.approx(1700000000.123456, abs=1e-6)


def test_colours_and_big_endian_pixels_come_through():
    pixels = np.random.default_rng(0).integers(0, 255, (4, 5, 3)).astype(np.uint8)
    found = decoded(packed_image("Colour", 1.0, pixels, np.eye(4), components=3))
    np.testing.assert_array_equal(found.pixels, pixels)
    assert found.components == 3
    turned = pixels[:, :, 0].astype(">i2")
    np.testing.assert_array_equal(decoded(packed_image("a", 0.0, turned, np.eye(4))).pixels, turned)
    message, pixels, _ = igtl_examples.image()
    body = bytearray(message[58:])
    body[4] = 1
    body[72:] = np.frombuffer(body[72:], "<i2").astype(">i2").tobytes()
    found = decoded(with_body(message, bytes(body)))
    np.testing.assert_array_equal(found.pixels, pixels)
    assert found.pixels.dtype == np.dtype(np.int16)


@pytest.mark.parametrize(("told", "valid"), [
    ({}, True),
    ({"TransformStatus": "OK"}, True),
    ({"TransformValid": "True", "TransformStatus": "OK"}, True),
    ({"TransformValid": "False"}, False),
    ({"TransformStatus": "OUT_OF_VIEW"}, False),
])  # fmt: skip
def test_a_transform_of_plus_says_whether_the_tool_was_seen(told, valid):
    message, matrix = igtl_examples.transform(version=2, **told)
    found = decoded(message)
    assert (found.device, found.valid) == ("ProbeToTracker", valid)
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-5)


@pytest.mark.parametrize("valid", [True, False])
def test_a_transform_of_ours_is_read_by_pyigtl(valid):
    _, matrix = igtl_examples.transform()
    message = packed_transform("ImageToReference", 3.5, matrix, valid)
    theirs, ours = by_pyigtl(message), decoded(message)
    np.testing.assert_allclose(theirs.matrix, matrix, atol=1e-5)
    np.testing.assert_allclose(ours.matrix, matrix, atol=1e-5)
    assert ours.valid == valid
    assert theirs.metadata.get("TransformValid") == (None if valid else "False")


def test_texts_states_and_others():
    assert decoded(packed_text("Check", 1.0, "too fast – slower")) == TextReceived(
        "Check", 1.0, "too fast \\u2013 slower"
    )
    assert by_pyigtl(packed_text("Check", 1.0, "lifted")).string == "lifted"
    assert decoded(packed_status("Check", 2.0, "lifted", 5)) == StatusReceived("Check", 2.0, 5, "lifted")
    assert decoded(igtl_examples.status("well")) == StatusReceived("Server", 7.5, 1, "well")
    points = pyigtl.PointMessage([[1.0, 2, 3]], names=["a"], device_name="Marks", timestamp=4.0).pack()
    assert decoded(points) == Other("Marks", 4.0, "POINT")


def test_the_fast_check_sum_is_pyigtls():
    for size in (0, 1, 7, 1000):
        data = np.random.default_rng(size).bytes(size)
        assert ecma_182(data) == CRC64(data)


def with_body(message, body):
    """The message with another body and the right length and check sum."""
    fields = list(igtl_examples.HEADER.unpack(message[:58]))
    fields[5:] = len(body), CRC64(body)
    return igtl_examples.HEADER.pack(*fields) + body


IMAGE = igtl_examples.image()[0]


def changed(at, form, *values):
    body = bytearray(IMAGE[58:])
    struct.pack_into(form, body, at, *values)
    return with_body(IMAGE, bytes(body))


@pytest.mark.parametrize(("message", "said"), [
    (IMAGE[:-1], "body of 180 bytes, got 179"),
    (IMAGE[:-1] + bytes([IMAGE[-1] ^ 1]), "check sum"),
    (with_body(IMAGE, IMAGE[58:-1]), "expected 180 bytes for an image of .6, 9, 1., got 179"),
    (with_body(IMAGE, IMAGE[58:100]), "expected an image, got 42 bytes"),
    (changed(2, "B", 0), "0 components"),
    (changed(3, "B", 9), "type 9"),
    (changed(4, "B", 3), "order 3"),
    (changed(6, ">3H", 65535, 65535, 65535), "whole image"),
    (changed(3, "B", 11), "expected 504 bytes for an image of .6, 9, 1., got 180"),
    (changed(6, ">3H", 0, 9, 1), "whole image"),
    (changed(66, ">3H", 3, 9, 1), "whole image"),
    (changed(12, ">f", float("nan")), "finite"),
    (changed(48, ">f", float("inf")), "finite"),
    (with_body(igtl_examples.transform()[0], bytes(47)), "cannot be unpacked"),
    (with_body(igtl_examples.transform(version=2)[0], bytes(60)), "extended header of 12 bytes, got 0"),
    (
        with_body(igtl_examples.transform(version=2)[0], struct.pack(">HHII", 12, 5, 2**31, 0) + bytes(48)),
        "metadata within 60 bytes, got 5 and 2147483648",
    ),
    (with_body(packed_text("a", 1.0, "words"), b"\0\7\0\5words"), "cannot be unpacked"),
    (b"\0\0" + IMAGE[2:], "version 0"),
    (IMAGE[:2] + b"\xff" * 12 + IMAGE[14:], "header of a message"),
    (IMAGE[:42] + b"\xff" * 8 + IMAGE[50:], "at most 67108864 bytes, got 18446744073709551615"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused_in_one_line(message, said):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(MessageError, match=said) as error:
            decoded(message)
    assert str(error.value).isprintable()


def test_limits_are_for_images_and_for_others():
    limits = Limits(max_body_bytes=179, max_other_body_bytes=48)
    with pytest.raises(MessageError, match="at most 179 bytes, got 180"):
        decoded(IMAGE, limits)
    assert isinstance(decoded(igtl_examples.transform()[0], limits), TransformReceived)


@pytest.mark.parametrize(("values", "said"), [
    (("d" * 21, 0.0, np.zeros((3, 4), np.uint8)), "at most 20 letters"),
    (("d", -0.5, np.zeros((3, 4), np.uint8)), "time from 0"),
    (("d", 0.0, np.zeros((3, 70000), np.uint8)), "65535 each"),
    (("d", 0.0, np.zeros((3, 0), np.uint8)), "65535 each"),
    (("d", 0.0, np.zeros((3, 4), np.complex64)), "complex64"),
    (("d", 0.0, np.zeros(3, np.uint8)), "column, row"),
])  # fmt: skip
def test_what_openigtlink_cannot_hold_is_not_packed(values, said):
    with pytest.raises(InvalidInputError, match=said):
        packed_image(*values, np.eye(4))
