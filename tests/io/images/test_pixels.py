"""Pixels of image files, beside their headers or in them, of either byte order."""

import numpy as np
import pytest
from image_examples import frame_fields, grey, write_mha

from speckle3d.io.images.headers import read_header


def header_and_pixels(folder, name, suffix):
    """A header whose pixels are in another file."""
    whole = write_mha(folder / "whole.mha", grey(), frames=frame_fields(3)[2]).read_bytes()
    head, _, pixels = whole.partition(b"LOCAL\n")
    path = folder / f"header{suffix}"
    if suffix == ".nhdr":
        head = b"NRRD0004\ndimension: 3\nencoding: raw\nsizes: 5 4 3\ntype: uint8\nData File: "
    path.write_bytes(head + name.encode() + b"\n")
    return path, pixels


@pytest.mark.parametrize(("start", "suffix"), [(7, ".mhd"), (-1, ".mhd"), (-1, ".nhdr"), (0, ".nhdr")])
def test_pixels_behind_bytes_of_another_program(tmp_path, start, suffix):
    """Of -1, as MetaIO and NRRD have it, they are the file's last bytes."""
    path, pixels = header_and_pixels(tmp_path, "pixels.raw", suffix)
    field = f"HeaderSize = {start}\n" if suffix == ".mhd" else f"byte skip: {start}\nline skip: 1\n"
    name = "ElementDataFile" if suffix == ".mhd" else "Data File"
    path.write_text(path.read_text().replace(name, field + name))
    (tmp_path / "pixels.raw").write_bytes(b"a line\n" + pixels)
    np.testing.assert_array_equal(read_header(path).images(), grey())


@pytest.mark.parametrize("kind", ["int16", "float32"])
@pytest.mark.parametrize("big", [False, True])
def test_numbers_of_either_byte_order_are_read(tmp_path, kind, big):
    values = np.random.default_rng(0).integers(0, 100, (3, 4, 5)).astype(kind)
    path = write_mha(tmp_path / "a.mha", values, {"BinaryDataByteOrderMSB": str(big), "HeaderSize": "7"})
    if big:
        head, _, _ = path.read_bytes().partition(b"LOCAL\n")
        path.write_bytes(head + b"LOCAL\n" + values.byteswap().tobytes())
    np.testing.assert_array_equal(read_header(path).numbers(), values.ravel())
