"""Clarius raw packages: which files a recording has, in a tar file, a folder, or beside a raw file.

A tar file is read where it lies; nothing is extracted.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md): the files of a package.
"""

from __future__ import annotations

import re
import tarfile
from dataclasses import dataclass
from pathlib import Path

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import reading

_NAME = re.compile(r"(?!\.)(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<what>raw|ya?ml)(?:(?<=raw)\.lzo)?")
_FIELD = re.compile(rb"^(?:# raw data parameters|sampling rate:|size:|timestamp:)", re.MULTILINE)
_START_BYTES = 4096


@dataclass(frozen=True)
class Member:
    """A file of a package: a file on disk, or a run of bytes of a tar file.

    Attributes
    ----------
    path : path
        The file on disk.
    name : str
        Of the member.
    start, size : int
        First byte in the file, and number of bytes.
    recording : tuple of str
        Folder and name of the recording that it is of.
    kind : str
        rf, iq, env or imu.
    is_raw : bool
        Whether it holds samples, and no description (yml).
    """

    path: Path
    name: str
    start: int
    size: int
    recording: tuple[str, str] = ("", "")
    kind: str = ""
    is_raw: bool = False

    @property
    def where(self) -> str:
        """Name for messages: the file, and the member where it is one."""
        return str(self.path) if self.path.name == Path(self.name).name else f"{self.path}: {self.name}"

    @property
    def is_own(self) -> bool:
        """Whether the scanner wrote it, unlike others' ``my_env.yml``."""
        return self.is_raw or _FIELD.search(self.read(_START_BYTES)) is not None

    def read(self, most: int | None = None) -> bytes:
        """Read all bytes, or the first ones."""
        with open_regular(self.path) as stream:
            stream.seek(self.start)
            return stream.read(self.size if most is None else min(self.size, most))

    def text(self) -> str:
        """All of it as text in UTF-8."""
        with reading(self.where):
            return self.read().decode("utf-8-sig")


@dataclass(frozen=True)
class Files:
    """Files of one recording: raw samples and descriptions by their kind.

    Attributes
    ----------
    path : path
        As it was given.
    name : str
        What the names of all its files begin with; a time stamp.
    """

    path: Path
    name: str
    raw: dict[str, Member]
    yml: dict[str, Member]


def is_package(path: Path, start: bytes) -> bool:
    """Whether a file or folder looks like a package, or one file of one."""
    try:
        if path.is_file() and (match := _NAME.fullmatch(path.name)):
            members = _members(path)
            is_described = any(one.kind == match["kind"] and not one.is_raw for one in members)
            return is_described and any(one.path == path and one.is_own for one in members)
        if path.is_dir() or path.suffix.lower() == ".tar" or start[257:262] == b"ustar":
            return any(member.is_own for member in _members(path))
    except (OSError, ValueError):
        pass
    return False


def find_files(path: Path) -> Files:
    """Find the files of a recording.

    Parameters
    ----------
    path : path
        A tar file, a folder, or a raw file or sidecar: then that kind alone, and the sensor's.

    Raises
    ------
    FileError
        If the package cannot be read.
    InvalidInputError
        If it holds several recordings or none.
    """
    members = _members(path)
    own = {member.recording for member in members if member.is_own}
    if len(own) != 1:
        names = ", ".join("/".join(one).removeprefix("./") for one in sorted(own))
        raise InvalidInputError(
            f"{path}: expected files of one recording, as 2024-05-01_rf.raw and _rf.yml, got "
            f"{len(own)}: {names}: give the raw file of one (of a tar file: unpack it first)"
        )
    (recording,) = own
    raw, yml = (
        {one.kind: one for one in members if one.recording == recording and one.is_raw == is_raw}
        for is_raw in (True, False)
    )
    return Files(path, recording[1], raw, yml)


def _members(path: Path) -> list[Member]:
    """Files of a folder or a tar file with the names of a package's; of a file, those of its recording."""
    match = None if path.is_dir() else _NAME.fullmatch(path.name)
    if match is not None:
        kinds = {"rf", "iq", "env", "imu"} if match["kind"] == "imu" else {match["kind"], "imu"}
        siblings = _members(path.parent)
        return [one for one in siblings if one.recording[1] == (match["name"] or "") and one.kind in kinds]
    members = []
    with reading(path):
        if path.is_dir():
            places = [(file, file.name, 0, file.stat().st_size) for file in sorted(path.iterdir())]
        else:
            places = [(path, *entry) for entry in _tar_entries(path)]
    for file, name, start, size in places:
        if match := _NAME.fullmatch(Path(name).name):
            recording = str(Path(name).parent), match["name"] or ""
            members.append(Member(file, name, start, size, recording, match["kind"], match["what"] == "raw"))
    return members


def _tar_entries(path: Path) -> list[tuple[str, int, int]]:
    """Name, first byte and size of each file in a tar file."""
    with open_regular(path) as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
        entries = [(one.name, one.offset_data, one.size) for one in archive if one.isfile()]
        length = stream.seek(0, 2)
    for name, start, size in entries:
        if start + size > length:
            raise FileError(f"{path}: {name}: ends early: {length - start} of {size} bytes")
    return entries
