"""Clarius raw packages: which files a recording has, in a tar file, a folder, or beside a raw file.

A tar file is read where it lies; nothing is extracted.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md): the files of a package.
"""

from __future__ import annotations

import re
import tarfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import reading

_NAME = re.compile(
    r"(?!\.)(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<content>raw|ya?ml|tgc)(?:(?<=raw)\.lzo)?"
)
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
    recording : str
        Folder and name of the recording that it is of.
    kind : str
        rf, iq, env or imu.
    content : str
        raw of samples, yml or yaml of what describes them, tgc of their gain.
    """

    path: Path
    name: str
    start: int
    size: int
    recording: str = ""
    kind: str = ""
    content: str = ""

    @property
    def where(self) -> str:
        """Name for messages: the file, and the member where it is one."""
        return str(self.path) if self.path.name == Path(self.name).name else f"{self.path}: {self.name}"

    @property
    def is_of_scanner(self) -> bool:
        """Whether the scanner wrote it, unlike others' ``my_env.yml``."""
        return self.content in ("raw", "tgc") or _FIELD.search(self.read(_START_BYTES)) is not None

    def read(self, limit: int | None = None) -> bytes:
        """Read all bytes, or the first ones."""
        with open_regular(self.path) as stream:
            stream.seek(self.start)
            return stream.read(self.size if limit is None else min(self.size, limit))

    def text(self) -> str:
        """Content as text in UTF-8."""
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

    def require_samples(self) -> None:
        """Refuse descriptions without raw samples, and samples without a description.

        Raises
        ------
        InvalidInputError
            Naming the files that are lacking.
        """
        kinds = self.raw.keys() - self.yml.keys() if self.raw else self.yml.keys() - {"imu"}
        if kinds or not self.raw:
            start, suffix = f"{self.name}_" if self.name else "", "yml" if self.raw else "raw"
            lacks = " or ".join(f"{start}{kind}.{suffix}" for kind in sorted(kinds)) or "samples (.raw)"
            names = [Path(member.name).name for member in (*self.raw.values(), *self.yml.values())]
            raise InvalidInputError(
                f"{self.path}: expected {lacks} beside {', '.join(names) or 'their gain (.tgc)'}, got none"
            )


def is_package(path: Path, start: bytes) -> bool:
    """Whether a file or folder looks like a package, or one file of one."""
    is_part = path.is_file() and _NAME.fullmatch(path.name)
    if is_part or path.is_dir() or path.suffix.lower() == ".tar" or start[257:262] == b"ustar":
        with suppress(OSError, ValueError):
            return any(member.is_of_scanner for member in _members(path))
    return path.suffix.lower() == ".tar"  # one that is cut says so when it is read


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
    recordings = sorted({member.recording for member in members if member.is_of_scanner})
    if len(recordings) != 1:
        raise InvalidInputError(
            f"{path}: expected files of one recording, as 2024-05-01_rf.raw and _rf.yml, got those of "
            f"{', '.join(recordings) or 'none'}: give the raw file of one (of a tar file: unpack it first)"
        )
    members = [member for member in members if member.recording == recordings[0]]
    raw = {member.kind: member for member in members if member.content == "raw"}
    yml = {member.kind: member for member in members if member.content.startswith("y")}
    return Files(path, Path(recordings[0]).name, raw, yml)


def _members(path: Path) -> list[Member]:
    """Files of a folder or a tar file with the names of a package's; of a file, those of its recording."""
    with reading(path):
        if path.is_dir():
            places = [(file, file.name, 0, file.stat().st_size) for file in sorted(path.iterdir())]
        elif part := _NAME.fullmatch(path.name):
            kinds = {"rf", "iq", "env", "imu"} if part["kind"] == "imu" else {part["kind"], "imu"}
            members = _members(path.parent)
            return [file for file in members if file.recording == (part["name"] or "") and file.kind in kinds]
        else:
            # It is read to its end, so that one cut short is refused.
            with open_regular(path) as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
                files = [item for item in archive if item.isfile()]
                places = [(path, item.name, item.offset_data, item.size) for item in files]
    members = []
    for file, name, start, size in places:
        if part := _NAME.fullmatch(Path(name).name):
            recording = str(Path(name).with_name(part["name"])) if part["name"] else str(Path(name).parent)
            members.append(Member(file, name, start, size, recording, part["kind"], part["content"]))
    return members
