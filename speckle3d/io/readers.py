"""Readers of sweeps: one object a format, found by what a file holds. Other packages add theirs.

A package adds a format by an entry point of the group ``speckle3d.readers`` that names a `Reader`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import h5py

from speckle3d.core.errors import FileError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.sweep import Sweep
from speckle3d.io.hdf5 import SIGNATURE, open_hdf5, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.recordings import Facts, Recording
from speckle3d.io.recordings import Row as Row

GROUP = "speckle3d.readers"
START_BYTES = 4096

_OWN = (
    "sweeps", "challenge", "formats.uff", "formats.zea", "formats.dicom", "formats.matlab", "metaimage",
    "plus.device_set", "formats.ultrasonix", "clarius", "formats.pictures",
)  # fmt: skip
"""Modules of this package that have a reader, in the order in which they are asked."""


@dataclass(frozen=True)
class Reader:
    """How sweeps of one format are told and read.

    Attributes
    ----------
    format : str
        What `speckle3d info` calls it.
    claims : callable, optional
        Whether a recording is of this format, from its path and its first `START_BYTES` bytes, which are
        none for a folder. It raises nothing.
    read : callable
        The sweep of a recording, with `ImportSettings` for what it does not say; or a `Recording`, which
        makes the sweep, describes itself and tells what was assumed or left out. A generator yields rows of
        facts before it returns a `Recording`: they are told also where there is none.
    companions : callable
        Other files that the sweep's content depends on.
    takes_settings : bool
        Whether `read` uses its settings; false of formats that say all themselves.
    claims_hdf5 : callable, optional
        In place of `claims`: whether an open HDF5 file is of this format.
    """

    format: str
    claims: Callable[[Path, bytes], bool] | None
    read: Callable[[Path, ImportSettings], Sweep | Recording | Facts]
    companions: Callable[[Path], Sequence[Path]] = lambda _: ()
    takes_settings: bool = True
    claims_hdf5: Callable[[h5py.File], bool] | None = None


def find_reader(path: PathLike) -> Reader | None:
    """Find the reader that claims a recording, a file or a folder; None where none does.

    Raises
    ------
    FileError
        If there is no such file or folder, or it cannot be read.
    """
    place, start = Path(path), first_bytes(path)
    opened: Any = open_hdf5(path) if start.startswith(SIGNATURE) else nullcontext()
    with reading(path), opened as file:
        for reader in readers():
            if reader.claims is not None and reader.claims(place, start):
                return reader
            if reader.claims_hdf5 is not None and file is not None and reader.claims_hdf5(file):
                return reader
    return None


def first_bytes(path: PathLike) -> bytes:
    """First bytes of a file, none of a folder.

    Raises
    ------
    FileError
        If there is neither, or it cannot be read.
    """
    if Path(path).is_dir():
        return b""
    if not Path(path).exists():
        raise FileError(f"{path}: expected a file, got none")
    with open_regular(path) as stream:
        return stream.read(START_BYTES)


@cache
def readers() -> tuple[Reader, ...]:
    """All readers, those of other packages first."""
    return *_others(), *(import_module(f"speckle3d.io.{name}").READER for name in _OWN)


def _others() -> tuple[Reader, ...]:
    """Readers of other packages; one that cannot be loaded is told of and left out."""
    loaded = []
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            loaded.append(entry.load())
        except Exception as error:  # noqa: BLE001 - a lab's own code must not stop all others
            fault = f"it cannot be loaded: {type(error).__name__}: {error}"
            warnings.warn(f"entry point {entry.name} of {GROUP}: left out: {fault}", stacklevel=2)
    return tuple(loaded)
