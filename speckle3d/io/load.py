"""Open any recording that holds a sweep; the reader is chosen by content, not by name."""

import hashlib
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import h5py

from speckle3d.core.errors import InvalidInputError, Speckle3DError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.reconstruction import ImportRecord
from speckle3d.core.sweep import Sweep
from speckle3d.core.text import written_path
from speckle3d.io.family import sweeps
from speckle3d.io.formats import challenge
from speckle3d.io.formats.challenge import Landmarks
from speckle3d.io.hdf5 import file_format, reading, sha256_of
from speckle3d.io.images.metaimage import READER as _IMAGES
from speckle3d.io.import_settings import ImportSettings, settings_file, settings_for
from speckle3d.io.readers import Reader, claim, find_reader, first_bytes, readers
from speckle3d.io.recordings import Recording, Row

IMAGE = _IMAGES.format
"""Kind of MetaImage and NRRD files."""

_PACKED = (b"\x1f\x8b", b"PK\3\4", b"BZh", b"\xfd7zXZ", b"7z\xbc\xaf", b"Rar!")
"""First bytes of gzip, zip, bzip2, xz, 7-Zip and RAR."""

SIZED = (sweeps.FORMAT, challenge.FORMAT)
"""Kinds that always say how large their pixels are."""


def load_sweep(path: PathLike, settings: ImportSettings | None = None) -> Sweep:
    """Read a sweep from any recording that a reader claims: a file, or a folder that a scanner wrote.

    Parameters
    ----------
    path : path
    settings : ImportSettings, optional
        What the recording does not say, over what a TOML file beside it gives.

    Returns
    -------
    Sweep
        With frames that stay on disk until they are asked for, but for MATLAB files before version 7.3.

    Raises
    ------
    FileError
        If the recording cannot be read.
    InvalidInputError
        If it is of no known kind, or what it holds is not valid.
    MissingSettingsError
        Naming all that it does not say.

    Examples
    --------
    >>> sweep = load_sweep("data/phantom.h5")
    >>> len(sweep), sweep.frames[0].shape
    (96, (48, 3818))
    >>> sweep.grid.centre_mm.round(1).tolist()
    [7.0, 22.0, 0.0]
    """
    return replace(open_recording(path, settings).sweep, path=Path(path))


def open_recording(path: PathLike, settings: ImportSettings | None = None) -> Recording:
    """Open any recording that a reader claims: its sweep, what it says, and notes on how the sweep is made.

    Where its reader fails, the facts that it told before are kept, and the error.

    Raises
    ------
    FileError, InvalidInputError
        As of `load_sweep`; what a recording lacks is asked for when its sweep is.
    """
    place, rows = Path(path), list[Row]()
    with claim(path) as (reader, source):
        if reader is None:
            kind = family_format(path, source)
            raise InvalidInputError(f"{path}: expected format {sweeps.FORMAT!r}, got {kind!r}")
        file = settings_file(path)
        if not reader.takes_settings and file is not None and file.stem == place.name:
            raise InvalidInputError(
                f"{file}: expected none beside a {reader.format}, which says all itself: it would not be read"
            )
        settings = settings_for(path, settings)
        with reading(path), naming(str(path)):
            result = reader.read(source, settings)
            try:
                while isinstance(result, Generator):
                    rows.append(next(result))
            except StopIteration as end:
                result = replace(end.value, rows=rows)
            except Speckle3DError as error:
                if not rows:
                    raise
                result = Recording(place, settings, fault=error, rows=rows)
    return result if isinstance(result, Recording) else Recording(place, settings, ready=result)


def load_landmarks(path: PathLike) -> Landmarks | None:
    """Landmarks that come with a sweep; None for all but scans of the TUS-REC challenge."""
    return challenge.read_landmarks(path) if kind_of(path) == challenge.FORMAT else None


def import_record(path: PathLike) -> ImportRecord | None:
    """Settings that a file beside a recording gives; None where there is none, or it would not be read."""
    beside = _settings_beside(path, find_reader(path))
    if beside is None:
        return None
    return ImportRecord(written_path(beside.name), settings_for(path).model_dump_json(exclude_defaults=True))


def _settings_beside(path: PathLike, reader: Reader | None) -> Path | None:
    return settings_file(path) if reader is not None and reader.takes_settings else None


def recording_files(path: PathLike) -> list[Path]:
    """List the files that a recording's content depends on: itself, unless it is a folder, and companions."""
    place, reader = Path(path), find_reader(path)
    files = [] if place.is_dir() else [place]
    files += () if reader is None else reader.companions(place)
    if (beside := _settings_beside(path, reader)) is not None:
        files += [beside, *map(Path, filter(None, [settings_for(path).plus_config]))]
    return files


def recording_sha256(path: PathLike) -> str:
    """SHA-256 of all that a recording's content depends on, as 64 hexadecimal digits.

    Of a file alone, that of its bytes; with companions, or of a folder, that of a line of name and SHA-256
    for each file, sorted.
    """
    files = recording_files(path)
    if files == [Path(path)]:
        return sha256_of(path)
    lines = sorted(f"{file.name} {sha256_of(file)}" for file in files)
    return hashlib.sha256("\n".join(lines).encode(errors="surrogateescape")).hexdigest()


def kind_of(path: PathLike) -> str:
    """Tell what a recording is by its reader's format, or a file of the family by its own.

    Raises
    ------
    FileError
        If it cannot be read.
    InvalidInputError
        If it is of no known kind.
    """
    with claim(path) as (reader, source):
        return family_format(path, source) if reader is None else reader.format


def family_format(path: PathLike, source: Path | h5py.File) -> str:
    """Format of a file of the family that no reader claims, by its path or, of HDF5, the open file.

    Raises
    ------
    InvalidInputError
        If it is of no known kind.
    """
    formats = ", ".join(reader.format for reader in readers())
    if isinstance(source, h5py.File):
        if (kind := file_format(source)).startswith("speckle3d."):
            return kind
        content = f"HDF5 of another kind, with {', '.join(map(str, source)) or 'nothing'}"[:200]
    else:
        if first_bytes(path).startswith(_PACKED):
            raise InvalidInputError(f"{path}: expected a recording, got a packed file: unpack it first")
        content = "a folder that none of them is in" if Path(path).is_dir() else "another file"
    raise InvalidInputError(
        f"{path}: expected a recording ({formats}), got {content}. Logs of sensors are for "
        "`speckle3d imu info`, paths of poses for `speckle3d trajectory score`"
    )
