"""One door to every file that holds a sweep: the reader is chosen by what the file holds, not by its name.

To add a kind of sweep, give `kind_of` a way to tell it and `_READERS` its reader.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.core.sweep import Sweep
from speckle3d.io import challenge, sweeps
from speckle3d.io.challenge import Landmarks
from speckle3d.io.hdf5 import PathLike, file_format, open_hdf5, reading, require_file
from speckle3d.io.headers import is_metaimage, is_nrrd
from speckle3d.io.metaimage import ImportSettings, read_metaimage

IMAGE = "image"
"""Kind of MetaImage and NRRD files."""

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_SNIFFED_BYTES = 512

_READERS: dict[str, Callable[[PathLike, ImportSettings | None], Sweep]] = {
    sweeps.FORMAT: lambda path, _: sweeps.read_sweep(path),
    challenge.FORMAT: lambda path, _: challenge.read_challenge_scan(path),
    IMAGE: read_metaimage,
}
"""How sweeps of each kind are read."""


def load_sweep(path: PathLike, settings: ImportSettings | None = None) -> Sweep:
    """Read a sweep from a sweep file, a MetaImage or NRRD sequence, or a scan of the TUS-REC challenge.

    Parameters
    ----------
    path : path
    settings : ImportSettings, optional
        What the header of an image sequence lacks; the others need none.

    Returns
    -------
    Sweep
        With frames that stay on disk until they are asked for; those of image sequences are in memory.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is of no known kind, or what it holds is not valid.

    Examples
    --------
    >>> sweep = load_sweep("data/phantom.h5")
    >>> len(sweep), sweep.frames[0].shape
    (96, (48, 3818))
    >>> sweep.grid.centre_mm.round(1).tolist()
    [7.0, 22.0, 0.0]
    """
    # A file of another format is refused by the sweep file's own reader.
    return _READERS.get(kind_of(path), _READERS[sweeps.FORMAT])(path, settings)


def load_landmarks(path: PathLike) -> Landmarks | None:
    """Read the landmarks that come with a sweep; None for all but scans of the TUS-REC challenge."""
    return challenge.read_landmarks(path) if kind_of(path) == challenge.FORMAT else None


def companion_files(path: PathLike) -> list[Path]:
    """List other files that a sweep's content depends on."""
    return challenge.companion_files(path) if kind_of(path) == challenge.FORMAT else []


def kind_of(path: PathLike) -> str:
    """Tell what a file is: its HDF5 format, as ``"speckle3d.sweep"``, ``"TUS-REC scan"`` or ``"image"``.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is neither HDF5 with a format nor an image.
    """
    if sniff(path) == IMAGE:
        return IMAGE
    with reading(path), open_hdf5(path) as file:
        return challenge.FORMAT if challenge.is_challenge_scan(file) else file_format(file)


def sniff(path: PathLike) -> str:
    """Tell the container of a file from its first bytes: ``"hdf5"`` or ``"image"``.

    Raises
    ------
    FileError
        If there is no such file, or it cannot be read.
    InvalidInputError
        If it is neither.
    """
    require_file(path)
    with reading(path), open_regular(path) as stream:
        start = stream.read(_SNIFFED_BYTES)
    if start.startswith(_HDF5_SIGNATURE):
        return "hdf5"
    if is_metaimage(start) or is_nrrd(start):
        return IMAGE
    got = "an empty file" if not start else "something else"
    raise InvalidInputError(f"{path}: expected a sweep file, MetaImage or NRRD sequence, got {got}")
