"""Clarius raw packages: which files a recording has, in a tar file, a folder, or beside a raw file.

A tar file is read where it lies; nothing is extracted.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md): the files of a package.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import one_line, reading

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
    """

    path: Path
    name: str
    start: int
    size: int

    @property
    def where(self) -> str:
        """Name for messages: the file, and the member where it is one."""
        return str(self.path) if self.path.name == Path(self.name).name else f"{self.path}: {self.name}"

    @property
    def recording(self) -> tuple[str, str]:
        """Folder and name of the recording that it is of."""
        match = _NAME.fullmatch(Path(self.name).name)
        return str(Path(self.name).parent), (match and match["name"]) or ""

    @property
    def role(self) -> tuple[str, str]:
        """Kind (rf, iq, env or imu), and what it holds: raw, yml or tgc."""
        match = _NAME.fullmatch(Path(self.name).name)
        assert match is not None
        return match["kind"], match["what"].replace("yaml", "yml")

    @property
    def is_own(self) -> bool:
        """Whether the scanner wrote it, unlike others' ``my_env.yml``."""
        return self.role[1] == "raw" or _FIELD.search(self.read(0, _START_BYTES)) is not None

    def read(self, start: int = 0, size: int | None = None) -> bytes:
        """Read bytes from `start` on, all by default; fewer where the member ends."""
        left = max(self.size - start, 0)
        with reading(self.where), open_regular(self.path) as stream:
            stream.seek(self.start + start)
            return stream.read(left if size is None else min(size, left))

    def text(self) -> str:
        """All of it as text in UTF-8."""
        try:
            return self.read().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InvalidInputError(f"{self.where}: expected text in UTF-8, got other bytes") from error


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
        By kind and content, as `Member.role`.
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
        if _NAME.fullmatch(path.name) and path.is_file():
            member, roles = _whole(path), {other.role for other in _members(path)}
            return member.is_own and (member.role[1] != "raw" or (member.role[0], "yml") in roles)
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
    roles: dict[tuple[str, str], Member] = {}
    for member in members:
        if member.recording == recording and roles.setdefault(member.role, member) != member:
            first = roles[member.role].name
            raise InvalidInputError(f"{path}: expected one of {first} and {member.name}, got both")
    return Files(path, recording[1], roles)


def _members(path: Path) -> list[Member]:
    if path.is_dir():
        return _folder_members(path)
    if not _NAME.fullmatch(path.name):
        return _tar_members(path)
    asked = _whole(path)
    kinds = {asked.role[0], "imu"} if asked.role[0] != "imu" else {"rf", "iq", "env", "imu"}
    return [
        member
        for member in _folder_members(path.parent)
        if member.recording == asked.recording and (member.role[0] in kinds or member.role[1] == "tgc")
    ]


def _whole(path: Path) -> Member:
    with open_regular(path) as stream:
        return Member(path, path.name, 0, stream.seek(0, 2))


def _folder_members(folder: Path) -> list[Member]:
    with reading(folder):
        return [_whole(file) for file in sorted(folder.iterdir()) if _NAME.fullmatch(file.name)]


def _tar_members(path: Path) -> list[Member]:
    with open_regular(path) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        try:
            with tarfile.open(fileobj=stream, mode="r:") as archive:
                entries = [entry for entry in archive if entry.isfile()]
        except (tarfile.TarError, EOFError, ValueError, OverflowError) as error:
            raise FileError(f"{path}: expected a tar file, got a damaged one: {one_line(error)}") from error
    members = []
    for entry in entries:
        if _NAME.fullmatch(Path(entry.name).name):
            if entry.offset_data + entry.size > size:
                got = f"{size - entry.offset_data} of {entry.size} bytes"
                raise FileError(f"{path}: {entry.name}: ends early: {got}")
            members.append(Member(path, entry.name, entry.offset_data, entry.size))
    return members
