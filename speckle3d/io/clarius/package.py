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
from dataclasses import dataclass, field, replace
from pathlib import Path

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import one_line, reading

KINDS = ("rf", "iq", "env")
"""Names of raw files, the preferred one first."""

_NAME = re.compile(
    r"(?!\.)(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<what>raw|raw\.lzo|tgc\.yml|tgc|yml|yaml)"
)
_FIELD = re.compile(rb"^(?:# raw data parameters|# tgc curves|sampling rate:|size:|timestamp:)", re.MULTILINE)
_LOOKED_AT = 4096


@dataclass(frozen=True)
class Member:
    """A run of bytes in a file: all of it, or a member of a tar file.

    Attributes
    ----------
    path : path
        The file on disk.
    name : str
        Of the member, for messages.
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

    def read(self, start: int = 0, size: int | None = None) -> bytes:
        """Read bytes from `start` on, all by default; fewer where the member ends."""
        count = max(self.size - start, 0) if size is None else max(min(size, self.size - start), 0)
        with reading(self.where), open_regular(self.path) as stream:
            stream.seek(self.start + start)
            return stream.read(count)

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
    raw, settings, gains : mapping of str to Member
        By `KINDS`: samples, their description (yml), and gain by frame (tgc).
    sensor : Member, optional
        Samples of the sensor (imu).
    is_cut : bool
        Whether a tar file ends without the blocks that close one: what came after may be missing.
    """

    path: Path
    name: str
    raw: Mapping[str, Member] = field(default_factory=dict)
    settings: Mapping[str, Member] = field(default_factory=dict)
    gains: Mapping[str, Member] = field(default_factory=dict)
    sensor: Member | None = None
    is_cut: bool = False

    @property
    def members(self) -> tuple[Member, ...]:
        """All of its files."""
        sensor = () if self.sensor is None else (self.sensor,)
        return (*self.raw.values(), *self.settings.values(), *self.gains.values(), *sensor)


def is_package(path: Path, start: bytes) -> bool:
    """Whether a file or folder looks like a package, or one file of one."""
    try:
        if path.is_dir():
            return any(map(_is_own, _folder_members(path)))
        if (name := _NAME.fullmatch(path.name)) is not None:
            beside = {member.name for member in _folder_members(path.parent)}
            stem = path.name.removesuffix(".lzo").removesuffix(".raw")
            is_raw = name["what"].startswith("raw")
            return bool({f"{stem}.yml", f"{stem}.yaml"} & beside) if is_raw else _is_own(_whole(path))
        if path.suffix.lower() != ".tar" and start[257:262] != b"ustar":
            return False
        return any(map(_is_own, _tar_members(path)[0]))
    except (OSError, ValueError):
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
    if path.is_dir():
        return _only(path, _folder_members(path))
    name = _NAME.fullmatch(path.name)
    if name is None:
        members, is_cut = _tar_members(path)
        return replace(_only(path, members), is_cut=is_cut)
    members = []
    for member in _folder_members(path.parent):
        other = _parts(member)
        if other["name"] == name["name"] and (
            name["kind"] in (other["kind"], "imu")
            or other["kind"] == "imu"
            or other["what"].startswith("tgc")
        ):
            members.append(member)
    return _only(path, members)


def _parts(member: Member) -> dict[str, str]:
    """Recording, kind and content of a file, by its name."""
    name = _NAME.fullmatch(Path(member.name).name)
    assert name is not None
    return {key: value or "" for key, value in name.groupdict().items()} | {"name": name["name"] or ""}


def _is_own(member: Member) -> bool:
    """Whether a file is one that the scanner wrote, unlike others' ``my_env.yml``."""
    return _parts(member)["what"].startswith("raw") or _FIELD.search(member.read(0, _LOOKED_AT)) is not None


def _whole(path: Path) -> Member:
    with open_regular(path) as stream:
        return Member(path, path.name, 0, stream.seek(0, 2))


def _folder_members(folder: Path) -> list[Member]:
    with reading(folder):
        return [
            _whole(folder / name)
            for name in sorted(p.name for p in folder.iterdir() if _NAME.fullmatch(p.name))
        ]


def _tar_members(path: Path) -> tuple[list[Member], bool]:
    """Members that are files of packages, and whether the archive lacks its end."""
    members = []
    with open_regular(path) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        try:
            with tarfile.open(fileobj=stream, mode="r:") as archive:
                for entry in archive:
                    if not entry.isfile() or _NAME.fullmatch(Path(entry.name).name) is None:
                        continue
                    if entry.offset_data + entry.size > size:
                        raise FileError(
                            f"{path}: {entry.name}: ends early: {size - entry.offset_data} of {entry.size} "
                            "bytes"
                        )
                    members.append(Member(path, entry.name, entry.offset_data, entry.size))
                return members, size <= archive.offset
        except (tarfile.TarError, EOFError, ValueError, OverflowError) as error:
            raise FileError(f"{path}: expected a tar file, got a damaged one: {one_line(error)}") from error


def _only(path: Path, members: list[Member]) -> Files:
    """Sort members by recording, of which there must be one; others' sidecars alone are none."""
    recordings: dict[tuple[str, str], list[Member]] = {}
    for member in members:
        place = str(Path(member.name).parent), _parts(member)["name"]
        recordings.setdefault(place, []).append(member)
    recordings = {place: parts for place, parts in recordings.items() if any(map(_is_own, parts))}
    if not recordings:
        raise InvalidInputError(
            f"{path}: expected files like 2024-05-01_rf.raw, _iq.raw, _env.raw and their .yml, got none"
        )
    if len(recordings) > 1:
        names = ", ".join(f"{folder}/{name}".removeprefix("./") for folder, name in sorted(recordings))
        raise InvalidInputError(
            f"{path}: expected one recording, got {len(recordings)}: {names}: give the raw file of one (of "
            "a tar "
            "file: unpack it first)"
        )
    (((_, name), parts),) = recordings.items()
    tables: dict[str, dict[str, Member]] = {"raw": {}, "tgc": {}, "yml": {}}
    for member in parts:
        part = _parts(member)
        table = tables[part["what"][:3].replace("yam", "yml")]
        if part["kind"] in table:
            first = table[part["kind"]].name
            raise InvalidInputError(f"{path}: expected one of {first} and {member.name}, got both")
        table[part["kind"]] = member
    sensor = tables["yml"].pop("imu", None)
    return Files(path, name, tables["raw"], tables["yml"], tables["tgc"], sensor)
