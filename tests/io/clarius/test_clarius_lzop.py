"""Files of lzop: any run of their bytes; what is damaged is named by its block."""

import struct

import clarius_examples as examples
import numpy as np
import pytest

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.clarius.lzop import Unpacker
from speckle3d.io.clarius.package import Member

BLOCK = 256


def content(size=2000):
    rng = np.random.default_rng(0)
    # Some blocks become shorter, and one, of noise, does not: it is stored as it is.
    return bytes(700) + rng.bytes(600) + bytes(range(100)) * ((size - 1300) // 100)


def unpacker(tmp_path, packed, before=b""):
    path = tmp_path / "x_rf.raw.lzo"
    path.write_bytes(before + packed + b"after")
    return Unpacker(Member(path, path.name, len(before), len(packed)))


@pytest.mark.parametrize("flags", [0x1, 0x100, 0x3, 0x303, 0x0])
def test_any_run_of_bytes_is_unpacked(tmp_path, flags):
    plain = content()
    packed = examples.lzop_bytes(plain, block=BLOCK, flags=flags)
    found = unpacker(tmp_path, packed, before=b"of a tar file")
    assert found.size == len(plain)
    rng = np.random.default_rng(1)
    for start, stop in [(0, len(plain)), (0, 1), (BLOCK - 1, BLOCK + 1), (BLOCK, 2 * BLOCK), (1999, 2000)]:
        assert found.read(start, stop - start) == plain[start:stop]
    for start in rng.integers(0, 1900, 20):
        size = int(rng.integers(1, 2000 - start))
        assert found.read(int(start), size) == plain[start : start + size]


def test_each_damaged_byte_of_a_block_is_noticed(tmp_path):
    packed = bytearray(examples.lzop_bytes(content(), block=BLOCK, flags=0x3))
    first = packed.index(struct.pack(">I", BLOCK))
    for at in range(first, len(packed), 7):
        packed[at] ^= 0x55
        with pytest.raises(FileError, match=r"x_rf\.raw\.lzo: (block|expected)"):
            unpacker(tmp_path, bytes(packed)).read(0, 2000)
        packed[at] ^= 0x55


@pytest.mark.parametrize("size", [5, 30, 60, 200, -4])
def test_truncated_files_are_named(tmp_path, size):
    packed = examples.lzop_bytes(content(), block=BLOCK)[:size]
    with pytest.raises(FileError, match=r"x_rf\.raw\.lzo"):
        unpacker(tmp_path, packed).read(0, 2000)


def test_more_bytes_than_there_are_are_named(tmp_path):
    with pytest.raises(FileError, match="expected 2001 bytes unpacked, got 2000"):
        unpacker(tmp_path, examples.lzop_bytes(content(), block=BLOCK)).read(1, 2000)


def test_header_of_another_checksum_method_or_file_is_named(tmp_path):
    packed = bytearray(examples.lzop_bytes(content()))
    for at, message, error in (
        (3, "expected a file of lzop", FileError),
        (30, "header: expected the checksum", FileError),
    ):
        damaged = bytearray(packed)
        damaged[at] ^= 0xFF
        with pytest.raises(error, match=message):
            unpacker(tmp_path, bytes(damaged)).read(0, 1)
    with pytest.raises(InvalidInputError, match="without a filter"):
        unpacker(tmp_path, examples.lzop_bytes(content(), flags=0x401)).read(0, 1)


def test_a_block_of_absurd_length_is_refused_before_it_is_read(tmp_path):
    packed = examples.lzop_bytes(content(), block=BLOCK)
    at = packed.index(struct.pack(">II", BLOCK, 9))
    absurd = packed[:at] + struct.pack(">I", 2**31) + packed[at + 4 :]
    with pytest.raises(
        FileError, match=r"block 0: expected at most 1048576 bytes, packed in fewer, got 2147483648"
    ):
        unpacker(tmp_path, absurd).read(0, 1)
