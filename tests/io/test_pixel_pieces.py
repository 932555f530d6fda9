"""Pieces of pixels are what reading all at once gives, in any order and in flat memory."""

import bz2
import tracemalloc
import zlib

import numpy as np
import pytest
from image_examples import write_mha

from speckle3d.core.errors import FileError
from speckle3d.io.headers import read_header
from speckle3d.io.pixel_pieces import PixelPieces

SHAPE = (200, 7, 6)


def sequence(folder, packing, values, big=False):
    """Write an NRRD sequence by hand, as each packing has it."""
    raw = values.astype(values.dtype.newbyteorder(">" if big else "<")).tobytes()
    packed = {
        "raw": lambda: raw,
        "gzip": lambda: zlib.compress(raw, 1, 31),
        "bzip2": lambda: bz2.compress(raw),
        "text": lambda: " ".join(map(str, values.ravel())).encode(),
    }[packing]()
    sizes = " ".join(map(str, values.shape[::-1]))
    kind = f"endian: {'big' if big else 'little'}\ntype: {values.dtype}"
    head = f"NRRD0004\ndimension: 3\nencoding: {packing}\nsizes: {sizes}\n{kind}\n\n"
    path = folder / "a.nrrd"
    path.write_bytes(head.encode() + packed)
    return path


def pieces_of(path):
    header = read_header(path)
    return PixelPieces(header.pixels, header.size[0] * header.size[1])


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("packing", ["raw", "gzip", "bzip2", "text"])
def test_pieces_come_in_any_order(tmp_path, packing, big):
    values = np.random.default_rng(0).integers(-9000, 9000, SHAPE).astype(np.int16)
    pieces = pieces_of(sequence(tmp_path, packing, values, big))
    assert len(pieces) == len(values)
    order = np.random.default_rng(1).permutation(len(values))
    for i in [*range(5), *order[:60], len(values) - 1, 0, *range(190, 200)]:
        np.testing.assert_array_equal(pieces[int(i)], values[i].ravel())
    assert pieces[3].dtype == np.dtype(np.int16)
    with pytest.raises(IndexError):
        pieces[len(values)]


def test_a_longer_packed_sequence_takes_no_more_memory(tmp_path):
    peaks = []
    for frames in (100, 1000):
        values = np.random.default_rng(0).integers(0, 256, (frames, 64, 128)).astype(np.uint8)
        pieces = pieces_of(sequence(tmp_path, "gzip", values))
        tracemalloc.start()
        for i in range(frames):
            pieces[i]
        pieces[0]
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        pieces.close()
    # 8.2 MB of frames against 0.8 MB.
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 5e6


@pytest.mark.parametrize("packing", ["gzip", "bzip2"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda packed: packed[:-30], "expected 16800 bytes unpacked, got|damaged"),
        (lambda packed: packed[:200] + b"\xff" * 9 + packed[209:], "damaged|unpacked, got"),
    ],
)
def test_damage_is_named_with_the_frame(tmp_path, packing, change, message):
    values = np.random.default_rng(0).integers(-9000, 9000, SHAPE).astype(np.int16)
    path = sequence(tmp_path, packing, values)
    head, mark, packed = path.read_bytes().partition(b"\n\n")
    path.write_bytes(head + mark + change(packed))
    pieces = pieces_of(path)
    with pytest.raises(FileError, match=rf"a\.nrrd: frame \d+: .*({message})"):
        [pieces[i] for i in range(len(pieces))]


def test_more_than_the_header_says_is_refused_at_the_end(tmp_path):
    values = np.zeros(SHAPE, np.int16)
    path = sequence(tmp_path, "gzip", values)
    path.write_bytes(path.read_bytes().replace(b"sizes: 6 7 200", b"sizes: 6 7 199"))
    pieces = pieces_of(path)
    pieces[197]
    with pytest.raises(FileError, match=r"frame 198: expected 16716 bytes unpacked, got more"):
        pieces[198]


def test_a_file_that_shrinks_later_is_a_file_error(tmp_path):
    path = write_mha(tmp_path / "a.mha", np.zeros((3, 4, 5), np.uint8))
    pieces = pieces_of(path)
    path.write_bytes(path.read_bytes()[:-30])
    pieces[0]
    with pytest.raises(FileError, match=r"a\.mha: frame 2: expected 20 bytes, got 0"):
        pieces[2]
