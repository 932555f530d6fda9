"""Temporary files, and files on a disk that is full."""

import gc
import os
import signal

import h5py
import numpy as np
import pytest
from disks import limited
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import FileError, NoSpaceError
from speckle3d.core.parts import DiskFile, cannot_write, clear_parts, marked, part_beside


def test_what_a_killed_process_left_is_removed_and_what_is_at_work_is_not(tmp_path):
    target = tmp_path / "a[1].h5"
    left, other = part_beside(target), part_beside(tmp_path / "b.h5")
    left.touch()
    other.touch()
    with marked(live := part_beside(target)):
        clear_parts(target)
        assert sorted(tmp_path.iterdir()) == sorted([live, other])
    clear_parts(target)
    assert list(tmp_path.iterdir()) == [other]


@pytest.mark.parametrize("code", ["ENOSPC", "EFBIG", "EDQUOT", "EACCES"])
def test_only_a_lack_of_room_is_one(code):
    number = getattr(__import__("errno"), code)
    error = cannot_write("a.h5", OSError(number, os.strerror(number)))
    assert isinstance(error, FileError)
    assert isinstance(error, NoSpaceError) == (code != "EACCES")
    assert str(error) == f"a.h5: cannot be written: {os.strerror(number)}"


piece = st.tuples(st.integers(0, 60), st.binary(min_size=1, max_size=30))


@settings(deadline=None, max_examples=50)
@given(pieces=st.lists(piece, max_size=8), room=st.integers(0, 80))
def test_a_file_reads_as_written_however_much_of_it_is_on_the_disk(tmp_path_factory, pieces, room):
    expected = bytearray()
    with DiskFile(tmp_path_factory.mktemp("disk") / "f") as file:
        with limited(room):
            for at, data in pieces:
                expected.extend(bytes(max(0, at + len(data) - len(expected))))
                expected[at : at + len(data)] = data
                file.seek(at)
                assert file.write(memoryview(data)) == len(data)
        assert file.seek(0, os.SEEK_END) == len(expected)
        file.seek(0)
        assert file.read(len(expected)) == bytes(expected)
        if len(expected) > room:
            with pytest.raises(OSError, match="large"):
                file.check()
        file._failure = None


def test_a_signal_that_arrives_while_hdf5_calls_waits_for_the_next_check(tmp_path, monkeypatch):
    def interrupted(file, data):
        os.kill(os.getpid(), signal.SIGINT)
        return write(file, data)

    write, before = DiskFile.write, signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(DiskFile, "write", interrupted)
    monkeypatch.setattr("speckle3d.core.parts._CALLED_BY_HDF5", {interrupted.__code__})
    with pytest.raises(KeyboardInterrupt), DiskFile(tmp_path / "a") as disk:  # noqa: PT012
        disk.write(memoryview(b"written"))
        assert (tmp_path / "a").read_bytes() == b"written"
        disk.check()
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt), DiskFile(tmp_path / "a") as disk:
        disk.write(memoryview(b"again"))
    with pytest.raises(KeyboardInterrupt), DiskFile(tmp_path / "a"):
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("keep", [False, True])
def test_hdf5_closes_behind_a_block_that_a_signal_ended(tmp_path, keep, capfd):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = 1
    held = []
    with pytest.raises(KeyboardInterrupt), DiskFile(tmp_path / "a.h5", keep) as disk:  # noqa: PT012
        held.append(h5py.File(disk, "r+" if keep else "w"))
        held[0].create_dataset("y", data=np.arange(5000), chunks=(100,), compression="gzip")
        raise KeyboardInterrupt
    held.clear()
    gc.collect()
    assert capfd.readouterr() == ("", "")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = 1


@pytest.mark.parametrize("room", [0, 700, 3000, 9000])
def test_hdf5_closes_a_file_for_which_there_is_no_room(tmp_path, room):
    def write():
        with limited(room), DiskFile(tmp_path / "a.h5") as disk, h5py.File(disk, "w") as file:
            for name in "abc":
                file.create_dataset(name, data=np.arange(500), chunks=(100,), compression="gzip")

    with pytest.raises(OSError, match="large"):
        write()
    # The library is as good as new.
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = 1


def test_a_file_written_through_it_holds_what_was_written(tmp_path):
    values = np.random.default_rng(0).normal(size=(50, 40))
    with DiskFile(tmp_path / "a.h5") as disk, h5py.File(disk, "w") as file:
        file.create_dataset("x", data=values, chunks=(7, 40), compression="gzip")
    with DiskFile(tmp_path / "a.h5", keep=True) as disk, h5py.File(disk, "r+") as file:
        file["y"] = values[0]
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["x"], values)
        np.testing.assert_array_equal(file["y"], values[0])
