"""Clarius raw packages: which files a recording has, in a tar file, a folder, or beside a raw file.

A tar file is read where it lies; nothing is extracted.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md): the files of a package.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import reading

_NAME = re.compile(
    r"(?!\.)(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<what>raw|tgc|ya?ml)(?:(?<=raw)\.lzo|(?<=tgc)\.yml)?"
)
_FIELD = re.compile(rb"^(?:# raw data parameters|# tgc curves|sampling rate:|size:|timestamp:)", re.MULTILINE)
_START_BYTES = 4096


@dataclass(frozen=True)
class Member:
    """A run of bytes in a file: all of it, or a member of a tar file.

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
    what : str
        raw, yml or tgc.
    """

    path: Path
    name: str
    start: int
    size: int
    recording: tuple[str, str] = ("", "")
    kind: str = ""
    what: str = ""

    @property
    def where(self) -> str:
        """Name for messages: the file, and the member where it is one."""
        return str(self.path) if self.path.name == Path(self.name).name else f"{self.path}: {self.name}"

    @property
    def is_own(self) -> bool:
        """Whether the scanner wrote it, unlike others' ``my_env.yml``."""
        return self.what == "raw" or _FIELD.search(self.read(0, _START_BYTES)) is not None

    def read(self, start: int = 0, size: int | None = None) -> bytes:
        """Read bytes from `start` on, all by default; fewer where the member ends."""
        left = max(self.size - start, 0)
        with open_regular(self.path) as stream:
            stream.seek(self.start + start)
            return stream.read(left if size is None else min(size, left))

    def text(self) -> str:
        """All of it as text in UTF-8."""
        with reading(self.where):
            return self.read().decode("utf-8-sig")


@dataclass(frozen=True)
class Files:
    """Files of one recording.

    Attributes
    ----------
    path : path
        As it was given.
    name : str
        What the names of all its files begin with; a time stamp.
    members : mapping of (str, str) to Member
        By kind and content.
    """

    path: Path
    name: str
    members: Mapping[tuple[str, str], Member]

    def of(self, what: str) -> dict[str, Member]:
        """Files of raw samples, descriptions (yml) or gains (tgc) by kind."""
        return {kind: member for (kind, held), member in self.members.items() if held == what}


def is_package(path: Path, start: bytes) -> bool:
    """Whether a file or folder looks like a package, or one file of one."""
    try:
        if path.is_file() and (match := _NAME.fullmatch(path.name)):
            members = _members(path)
            described = any((one.kind, one.what) == (match["kind"], "yml") for one in members)
            return any(one.path == path and one.is_own for one in members) and (
                match["what"] != "raw" or described
            )
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
        A tar file, a folder, or a raw file or sidecar: then that kind alone, with all gains and the sensor's.

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
    roles = {(one.kind, one.what): one for one in members if one.recording == recording}
    return Files(path, recording[1], roles)


def _members(path: Path) -> list[Member]:
    if path.is_dir():
        with reading(path):
            return _named((file, file.name, 0, file.stat().st_size) for file in sorted(path.iterdir()))
    if (match := _NAME.fullmatch(path.name)) is None:
        return _named((path, *entry) for entry in _tar_entries(path))
    kinds = {"rf", "iq", "env", "imu"} if match["kind"] == "imu" else {match["kind"], "imu"}
    return [
        member
        for member in _members(path.parent)
        if member.recording[1] == (match["name"] or "") and (member.kind in kinds or member.what == "tgc")
    ]


def _named(places: Iterable[tuple[Path, str, int, int]]) -> list[Member]:
    """Members of the places whose names are those of a package."""
    members = []
    for path, name, start, size in places:
        if match := _NAME.fullmatch(Path(name).name):
            recording = str(Path(name).parent), match["name"] or ""
            what = match["what"].replace("yaml", "yml")
            members.append(Member(path, name, start, size, recording, match["kind"], what))
    return members


def _tar_entries(path: Path) -> list[tuple[str, int, int]]:
    """Name, first byte and size of each file in a tar file."""
    with reading(path), open_regular(path) as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
        entries = [(one.name, one.offset_data, one.size) for one in archive if one.isfile()]
        length = stream.seek(0, 2)
    for name, start, size in entries:
        if start + size > length:
            raise FileError(f"{path}: {name}: ends early: {length - start} of {size} bytes")
    return entries
