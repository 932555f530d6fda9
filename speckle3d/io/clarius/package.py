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

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import reading

_NAME = re.compile(
    r"(?!\.)(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<content>raw|ya?ml|tgc)(?:(?<=raw)\.lzo)?"
)


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

    def read(self) -> bytes:
        """Read all bytes."""
        with open_regular(self.path) as stream:
            stream.seek(self.start)
            return stream.read(self.size)

    def text(self) -> str:
        """Content as text in UTF-8."""
        with reading(self.where):
            return self.read().decode("utf-8-sig")


def is_package(path: Path, _: bytes) -> bool:
    """Whether a file or folder looks like a package, or one file of one."""
    with suppress(FileError):
        return bool(_members(path))
    return path.suffix.lower() == ".tar"  # one that is cut says so when it is read


def find_files(path: Path) -> tuple[str, dict[str, Member], dict[str, Member]]:
    """Find the files of a recording: what their names begin with, raw samples and descriptions by kind.

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
    # Others' files, as my_env.yml, have no raw samples.
    with_raw = {member.recording for member in members if member.content == "raw"}
    recordings = sorted(with_raw or {member.recording for member in members})
    if len(recordings) != 1:
        raise InvalidInputError(
            f"{path}: expected files of one recording, as 2024-05-01_rf.raw and _rf.yml, got those of "
            f"{', '.join(recordings) or 'none'}: give the raw file of one (of a tar file: unpack it first)"
        )
    members = [member for member in members if member.recording == recordings[0]]
    raw = {member.kind: member for member in members if member.content == "raw"}
    yml = {member.kind: member for member in members if member.content.startswith("y")}
    return Path(recordings[0]).name, raw, yml


def _members(path: Path) -> list[Member]:
    """Files of a folder or a tar file with the names of a package's; of a file, those of its recording."""
    with reading(path, tarfile.TarError):
        if path.is_dir():
            places = [(file, file.name, 0, file.stat().st_size) for file in sorted(path.iterdir())]
        elif part := _NAME.fullmatch(path.name):
            kinds = {"rf", "iq", "env", "imu"} if part["kind"] == "imu" else {part["kind"], "imu"}
            recording, members = str(Path(part["name"] or "")), _members(path.parent)
            return [file for file in members if file.recording == recording and file.kind in kinds]
        else:
            # It is read to its end, so that one cut short is refused.
            with open_regular(path) as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
                files = [item for item in archive if item.isfile()]
                places = [(path, item.name, item.offset_data, item.size) for item in files]
    members = []
    for file, name, start, size in places:
        if part := _NAME.fullmatch(Path(name).name):
            recording = str(Path(name).parent / (part["name"] or ""))
            members.append(Member(file, name, start, size, recording, part["kind"], part["content"]))
    return members
