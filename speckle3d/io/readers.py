"""Readers of sweeps, one for each format, chosen by content; other packages add theirs.

A package adds a format by an entry point of the group ``speckle3d.readers`` that names a `Reader`.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import h5py

from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.sweep import Sweep
from speckle3d.io.hdf5 import SIGNATURE, open_hdf5, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.recordings import Facts, Recording
from speckle3d.io.recordings import Row as Row

GROUP = "speckle3d.readers"
START_BYTES = 4096

_MODULES = (
    "family.sweeps", "formats.challenge", "formats.uff", "formats.zea", "formats.dicom", "formats.matlab",
    "images.metaimage", "plus.device_set", "formats.ultrasonix", "clarius.reader", "formats.pictures",
)  # fmt: skip
"""Modules of this package that have a reader, in the order in which they are asked."""


@dataclass(frozen=True)
class Reader:
    """Reader of one format: recognises recordings and reads sweeps.

    Attributes
    ----------
    format : str
        What `speckle3d info` calls it.
    claims : callable, optional
        Whether a recording is of this format, from its path and its first `START_BYTES` bytes, which are
        none for a folder. It raises nothing.
    read : callable
        The sweep of a recording, by its path or, of `claims_hdf5`, by the open file, with `ImportSettings`
        for what it does not say; or a `Recording`, which makes the sweep, describes itself and tells what was
        assumed or left out. A generator yields rows of facts before it returns a `Recording`: they are told
        also where there is none.
    companions : callable
        Other files that the sweep's content depends on.
    takes_settings : bool
        Whether `read` uses its settings; false of formats that say all themselves.
    claims_hdf5 : callable, optional
        In place of `claims`: whether an open HDF5 file is of this format.
    """

    format: str
    claims: Callable[[Path, bytes], bool] | None
    read: Callable[[Any, ImportSettings], Sweep | Recording | Facts]
    companions: Callable[[Path], Sequence[Path]] = lambda _: ()
    takes_settings: bool = True
    claims_hdf5: Callable[[h5py.File], bool] | None = None


@contextmanager
def claim(path: PathLike) -> Iterator[tuple[Reader | None, Path | h5py.File]]:
    """Yield the reader that claims a recording, None where none does, and its path or open HDF5 file.

    Raises
    ------
    FileError
        If there is no such file or folder, or it cannot be read.
    """
    place, start = Path(path), first_bytes(path)
    with open_hdf5(path) if start.startswith(SIGNATURE) else nullcontext() as file:

        def is_of(reader: Reader) -> bool:
            if file is not None and reader.claims_hdf5 is not None:
                return reader.claims_hdf5(file)
            return reader.claims is not None and reader.claims(place, start)

        with reading(path):
            reader = next(filter(is_of, readers()), None)
        takes_file = reader is None or reader.claims_hdf5 is not None
        yield reader, file if file is not None and takes_file else place


def find_reader(path: PathLike) -> Reader | None:
    """Find the reader that claims a recording, as `claim` does."""
    with claim(path) as (reader, _):
        return reader


def first_bytes(path: PathLike) -> bytes:
    """First bytes of a file, none of a folder.

    Raises
    ------
    FileError
        If there is neither, or it cannot be read.
    """
    if Path(path).is_dir():
        return b""
    with open_regular(path) as stream:
        return stream.read(START_BYTES)


@cache
def readers() -> tuple[Reader, ...]:
    """All readers, those of other packages first."""
    return *_plugins(), *(import_module(f"speckle3d.io.{name}").READER for name in _MODULES)


def _plugins() -> tuple[Reader, ...]:
    """Readers of other packages; one that cannot be loaded is told of and left out."""
    plugins = []
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            plugins.append(entry.load())
        except Exception as error:  # noqa: BLE001 - a lab's own code must not stop all others
            fault = f"it cannot be loaded: {type(error).__name__}: {error}"
            warnings.warn(f"entry point {entry.name} of {GROUP}: left out: {fault}", stacklevel=2)
    return tuple(plugins)
