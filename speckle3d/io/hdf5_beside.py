"""HDF5 files that are being written, or whose writer was killed: told, and opened beside it."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress

import h5py

from speckle3d.core.files import PathLike, open_regular

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file without a user block."""

CHUNK_CACHE_BYTES = 32 * 2**20
"""Room for files whose chunks span several frames; with one chunk per frame it is never filled."""

_SWMR_WRITE = 0x04

_READ_ATTEMPTS = 20
"""Of what may be half written: a millisecond in all."""


def has_writer(path: PathLike) -> bool:
    """Whether a file is being written in HDF5's single-writer mode, or its writer was killed [1]_.

    It is then to be opened as by a reader beside a writer, which does not look at a file's length.

    References
    ----------
    .. [1] HDF5 File Format Specification 3.0, II.A: consistency flags of a superblock of version 3.
    """
    with open_regular(path) as stream:
        start = stream.read(12)
    return start.startswith(SIGNATURE) and start[8:9] == b"\x03" and bool(start[11] & _SWMR_WRITE)


def open_beside_writer(path: PathLike) -> h5py.File:
    """Open a file that is being written, or whose writer was killed.

    What is half written is read anew, a hundred times by HDF5's own choice, each after twice the time: in a
    damaged file, for good. h5py has no word for fewer, so HDF5 itself is told.
    """
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    slots, buckets, _, weight = access.get_cache()
    access.set_cache(slots, buckets, CHUNK_CACHE_BYTES, weight)
    with suppress(OSError, AttributeError):  # Windows does not give away what a library loads
        tell = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
        tell(ctypes.c_int64(access.id), ctypes.c_uint(_READ_ATTEMPTS))
    flags = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
    return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))
