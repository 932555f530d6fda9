"""Readers of sweeps: one object a format, found by what a file holds. Other packages add theirs.

A package adds a format by an entry point of the group ``speckle3d.readers`` that names a `Reader`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from speckle3d.core.errors import FileError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.sweep import Sweep
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.recordings import Recording
from speckle3d.io.recordings import Row as Row

GROUP = "speckle3d.readers"
START_BYTES = 4096

_OWN = (
    "sweeps", "challenge", "formats.uff", "formats.zea", "formats.dicom", "formats.matlab", "metaimage",
    "plus.documents", "formats.ultrasonix", "clarius", "formats.pictures",
)  # fmt: skip
"""Modules of this package that have a reader, in the order in which they are asked."""


def _nothing_beside(_: Path) -> Sequence[Path]:
    return ()


def _nothing_to_say(_: Path, __: ImportSettings) -> Sequence[str]:
    return ()


@dataclass(frozen=True)
class Reader:
    """How sweeps of one format are told and read.

    Attributes
    ----------
    format : str
        What `speckle3d info` calls it.
    claims : callable
        Whether a recording is of this format, from its path and its first `START_BYTES` bytes, which are
        none for a folder. It raises nothing.
    read : callable
        The sweep of a recording, with `ImportSettings` for what it does not say; or a `Recording`, which
        makes the sweep and describes itself.
    describe : callable, optional
        Rows of what a recording holds, also where it is no sweep; by default the sweep's or
        the `Recording`'s.
    companions : callable
        Other files that the sweep's content depends on.
    notes : callable
        What a user should know of how a sweep was made: what was assumed, measured or left out.
    takes_settings : bool
        Whether `read` uses its settings; false of formats that say all themselves.
    """

    format: str
    claims: Callable[[Path, bytes], bool]
    read: Callable[[Path, ImportSettings], Sweep | Recording]
    describe: Callable[[Path, ImportSettings], list[Row]] | None = None
    companions: Callable[[Path], Sequence[Path]] = _nothing_beside
    notes: Callable[[Path, ImportSettings], Sequence[str]] = _nothing_to_say
    takes_settings: bool = True


def find_reader(path: PathLike) -> Reader | None:
    """Find the reader that claims a recording, a file or a folder; None where none does.

    Raises
    ------
    FileError
        If there is no such file or folder, or it cannot be read.
    """
    place = Path(path)
    start = first_bytes(place)
    return next((reader for reader in readers() if _claims(reader, place, start)), None)


def _claims(reader: Reader, path: Path, start: bytes) -> bool:
    """Ask a reader; one of another package that fails is told of and does not claim."""
    if reader in _own():
        return reader.claims(path, start)
    try:
        return reader.claims(path, start)
    except Exception as error:  # noqa: BLE001 - a lab's own code must not stop all others
        warnings.warn(
            f"reader of {reader.format}: left out for {path}: it fails: {type(error).__name__}: {error}",
            stacklevel=2,
        )
        return False


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
    return (*_others(), *_own())


@cache
def _own() -> tuple[Reader, ...]:
    return tuple(import_module(f"speckle3d.io.{name}").READER for name in _OWN)


def _others() -> tuple[Reader, ...]:
    """Readers of other packages; one that cannot be loaded is told of and left out."""
    found = []
    for entry in sorted(entry_points(group=GROUP), key=lambda each: each.name):
        try:
            reader = entry.load()
        except Exception as error:  # noqa: BLE001 - a lab's own code must not stop all others
            fault = f"it cannot be loaded: {type(error).__name__}: {error}"
        else:
            if isinstance(reader, Reader):
                found.append(reader)
                continue
            fault = f"expected a Reader, got {type(reader).__name__}"
        warnings.warn(f"entry point {entry.name} of {GROUP}: left out: {fault}", stacklevel=2)
    return tuple(found)
