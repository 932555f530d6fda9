"""Pixels of image files lie in the header's own folder, and take no more memory than is plausible."""

import gzip
import os
import zlib

import numpy as np
import pytest
from image_examples import grey, tracked, write_mha
from speckle3d.io.pixels import map_pixels

from speckle3d.core.errors import Speckle3DError
from speckle3d.io.headers import read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.metaimage import read_metaimage
from speckle3d.io.voxels.volumes import read_volume

BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)


def detached(folder, name, suffix=".mhd"):
    """A header whose pixels are in another file."""
    whole = write_mha(folder / "whole.mha", grey(), frames=tracked(3)[2]).read_bytes()
    head, _, pixels = whole.partition(b"LOCAL\n")
    path = folder / f"header{suffix}"
    if suffix == ".nhdr":
        head = b"NRRD0004\ndimension: 3\nencoding: raw\nsizes: 5 4 3\ntype: uint8\nData File: "
    path.write_bytes(head + os.fsencode(name) + b"\n")
    return path, pixels


@pytest.mark.parametrize("suffix", [".mhd", ".nhdr"])
@pytest.mark.parametrize("name", ["pixels.raw", "below/../pixels.raw"])
def test_pixels_beside_the_header_are_read(tmp_path, name, suffix):
    path, pixels = detached(tmp_path, name, suffix)
    (tmp_path / "below").mkdir()
    (tmp_path / name).write_bytes(pixels)
    np.testing.assert_array_equal(map_pixels(read_header(path).pixels), grey().ravel())


@pytest.mark.parametrize("suffix", [".mhd", ".nhdr"])
@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../secret.raw", "link.raw", "below/secret.raw", "LIST", "pipe", "below", "none.raw"],
)  # fmt: skip
def test_other_files_are_refused_in_one_line(tmp_path, name, suffix):
    folder = tmp_path / "folder"
    (tmp_path / "outside").mkdir()
    folder.mkdir()
    (tmp_path / "secret.raw").write_bytes(bytes(100))
    (tmp_path / "outside" / "secret.raw").write_bytes(bytes(100))
    (folder / "link.raw").symlink_to(tmp_path / "secret.raw")
    (folder / "below").symlink_to(tmp_path / "outside", target_is_directory=True)
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "pipe")
    path, _ = detached(folder, name, suffix)
    given = BMODE.model_copy(update={"frame_rate_hz": 10.0})
    for read in (read_volume, lambda p: read_metaimage(p, given)):
        with pytest.raises(Speckle3DError) as caught:
            read(path)
        assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("start", "suffix"), [(7, ".mhd"), (-1, ".mhd"), (7, ".nhdr"), (-1, ".nhdr")])
def test_pixels_behind_bytes_of_another_program(tmp_path, start, suffix):
    """Of -1, as MetaIO and NRRD have it, they are the file's last bytes."""
    path, pixels = detached(tmp_path, "pixels.raw", suffix)
    field = f"HeaderSize = {start}\nElementDataFile" if suffix == ".mhd" else f"byte skip: {start}\nData File"
    text = path.read_bytes().decode()
    path.write_text(text.replace("ElementDataFile" if suffix == ".mhd" else "Data File", field))
    (tmp_path / "pixels.raw").write_bytes(bytes(7 if start else 0) + pixels)
    np.testing.assert_array_equal(read_header(path).images(), grey())


def packed_sequence(path, size, packed, kind="mha"):
    if kind == "mha":
        fields = {"DimSize": size, "CompressedData": "True", "CompressedDataSize": len(packed)}
        whole = write_mha(path, grey(), fields)
        head, _, _ = whole.read_bytes().partition(b"LOCAL\n")
        path.write_bytes(head + b"LOCAL\n" + packed)
        return path
    head = f"NRRD0004\ndimension: 3\nencoding: gzip\nsizes: {size}\ntype: uint8\n\n"
    path.write_bytes(head.encode() + packed)
    return path


@pytest.mark.parametrize("kind", ["mha", "nrrd"])
@pytest.mark.parametrize(
    ("size", "content", "message"),
    [
        ("5 4 3", bytes(59), "ends early: 2 of 3 frames"),
        ("5 4 3", bytes(10**7), "60 bytes.*got more"),
    ],
)
def test_packed_pixels_are_as_many_as_the_header_says(tmp_path, kind, size, content, message):
    pack = zlib.compress if kind == "mha" else gzip.compress
    path = packed_sequence(tmp_path / f"a.{kind}", size, pack(content), kind)
    with pytest.raises(Speckle3DError, match=rf"a\.{kind}: .*{message}"):
        map_pixels(read_header(path).pixels)


@pytest.mark.parametrize("kind", ["int16", "float32"])
@pytest.mark.parametrize("big", [False, True])
def test_numbers_of_either_byte_order_are_read(tmp_path, kind, big):
    values = np.random.default_rng(0).integers(0, 100, (3, 4, 5)).astype(kind)
    path = write_mha(tmp_path / "a.mha", values, {"BinaryDataByteOrderMSB": str(big)})
    if big:
        head, _, _ = path.read_bytes().partition(b"LOCAL\n")
        path.write_bytes(head + b"LOCAL\n" + values.byteswap().tobytes())
    got = map_pixels(read_header(path).pixels)
    assert got.dtype == values.dtype
    np.testing.assert_array_equal(got, values.ravel())
