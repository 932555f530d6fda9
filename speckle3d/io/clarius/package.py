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

KINDS = ("rf", "iq", "env")
"""Names of raw files, the preferred one first."""

_RAW = re.compile(r"(?:(?P<name>.*)_)?(?P<kind>rf|iq|env)\.raw(?:\.lzo)?")
_SIDE = re.compile(r"(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<what>tgc\.yml|tgc|yml|yaml)")

_FIELD = re.compile(rb"^(?:# raw data parameters|# tgc curves|sampling rate:|size:|timestamp:)", re.MULTILINE)
_LOOKED_AT = 4096

_MOST_MEMBERS = 10_000
"""A package has a dozen."""

_MOST_TEXT_BYTES = 2**26
"""An hour of the sensor at 80 Hz."""


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

    def begins(self, size: int) -> bytes:
        """Read its first bytes."""
        with open_regular(self.path) as stream:
            stream.seek(self.start)
            return stream.read(min(size, self.size))

    def text(self) -> str:
        """Read all of it as text in UTF-8.

        Raises
        ------
        FileError
            If it cannot be read, or is far too long.
        InvalidInputError
            If it is no text.
        """
        if self.size > _MOST_TEXT_BYTES:
            raise FileError(f"{self.where}: expected at most {_MOST_TEXT_BYTES} bytes, got {self.size}")
        with open_regular(self.path) as stream:
            stream.seek(self.start)
            content = stream.read(self.size)
        try:
            return content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InvalidInputError(f"{self.where}: expected text in UTF-8, got other bytes") from error


@dataclass(frozen=True)
class Recording:
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
    cut : bool
        Whether a tar file ends without the blocks that close one: what came after may be missing.
    """

    path: Path
    name: str
    raw: Mapping[str, Member] = field(default_factory=dict)
    settings: Mapping[str, Member] = field(default_factory=dict)
    gains: Mapping[str, Member] = field(default_factory=dict)
    sensor: Member | None = None
    cut: bool = False

    @property
    def members(self) -> tuple[Member, ...]:
        """All of its files."""
        sensor = () if self.sensor is None else (self.sensor,)
        return (*self.raw.values(), *self.settings.values(), *self.gains.values(), *sensor)


def is_package(path: Path, start: bytes) -> bool:
    """Whether a file or folder looks like a package, or one raw file of one."""
    try:
        if path.is_dir():
            return any(_is_own(each, each.name) for each in path.iterdir())
        if _SIDE.fullmatch(path.name):
            return _is_own(path, path.name)
        if _RAW.fullmatch(path.name):
            return bool(_sidecar(path, "yml"))
        if path.suffix.lower() != ".tar" and start[257:262] != b"ustar":
            return False
        with open_regular(path) as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
            return any(
                _is_own(path, Path(each.name).name, each.offset_data) for each in archive if each.isfile()
            )
    except (OSError, ValueError, tarfile.TarError, EOFError, MemoryError):
        return False


def _is_own(file: Path, name: str, start: int = 0) -> bool:
    """Whether a file is one of a package by its name and, but for raw files, its content."""
    if _parsed(name) is None:
        return False
    return _RAW.fullmatch(name) is not None or _has_fields(Member(file, name, start, _LOOKED_AT))


def _has_fields(member: Member) -> bool:
    """Whether a sidecar begins as the scanner writes them, unlike others' ``my_env.yml``."""
    return _FIELD.search(member.begins(_LOOKED_AT)) is not None


def find_recording(path: Path) -> Recording:
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
        If it holds several recordings or none, or members that reach outside it.
    """
    if path.is_dir():
        return _only(path, _folder_members(path))
    if (named := _parsed(path.name)) is None:
        members, cut = _tar_members(path)
        return replace(_only(path, members), cut=cut)
    prefix, kind = named
    beside = [each for each in _folder_members(path.parent) if _parsed(Path(each.name).name) == named]
    kinds = (kind,) if kind != "imu" else (*KINDS, kind)
    others = [
        each
        for each in _folder_members(path.parent)
        if (other := _parsed(Path(each.name).name)) is not None
        and other[0] == prefix
        and other[1] not in kinds
        and (other[1] == "imu" or _is_gain(each))
    ]
    return _only(path, [*beside, *others])


def _is_gain(member: Member) -> bool:
    return member.name.endswith((".tgc", ".tgc.yml"))


def _parsed(name: str) -> tuple[str, str] | None:
    """Recording and kind of a file by its name; None for other files, and those that file managers hide."""
    found = None if name.startswith(".") else _RAW.fullmatch(name) or _SIDE.fullmatch(name)
    return None if found is None else (found["name"] or "", found["kind"])


def _sidecar(raw: Path, what: str) -> Path | None:
    stem = raw.name.removesuffix(".lzo").removesuffix(".raw")
    found = (raw.with_name(f"{stem}.{end}") for end in (what, what.replace("yml", "yaml")))
    return next((each for each in found if each.is_file()), None)


def _folder_members(folder: Path) -> list[Member]:
    inside = folder.resolve()
    members = []
    try:
        names = sorted(each.name for each in folder.iterdir() if _parsed(each.name))
    except OSError as error:
        raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
    for name in names:
        file = folder / name
        if not file.resolve().is_relative_to(inside):
            raise InvalidInputError(
                f"{file}: expected a file in the package's own folder, got a link out of it"
            )
        with open_regular(file) as stream:
            members.append(Member(file, name, 0, stream.seek(0, 2)))
    return members


def _tar_members(path: Path) -> tuple[list[Member], bool]:
    """Members that are files of packages, and whether the archive lacks its end."""
    members = []
    try:
        with open_regular(path) as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            with tarfile.open(fileobj=stream, mode="r:") as archive:
                for count, entry in enumerate(archive):
                    if count >= _MOST_MEMBERS:
                        raise InvalidInputError(f"{path}: expected at most {_MOST_MEMBERS} members, got more")
                    _require_inside(path, entry)
                    if not entry.isfile() or _parsed(Path(entry.name).name) is None:
                        continue
                    if entry.offset_data + entry.size > size:
                        raise FileError(
                            f"{path}: {entry.name}: expected {entry.size} bytes, got "
                            f"{size - entry.offset_data}: truncated"
                        )
                    members.append(Member(path, entry.name, entry.offset_data, entry.size))
                return members, _is_cut(path, archive.offset, size)
    except (tarfile.TarError, EOFError, ValueError, OverflowError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise FileError(f"{path}: expected a tar file, got a damaged one: {error}") from error


def _is_cut(path: Path, end: int, size: int) -> bool:
    """Whether nothing closes an archive whose members end at `end`, as some writers leave it.

    Raises
    ------
    FileError
        If part of a header is there, or something that is none: `tarfile` ends in silence.
    """
    if size <= end:
        return True
    with open_regular(path) as stream:
        stream.seek(end)
        block = stream.read(tarfile.BLOCKSIZE)
    if len(block) < tarfile.BLOCKSIZE:
        raise FileError(
            f"{path}: expected a member or the archive's end at byte {end}, got {len(block)} bytes: truncated"
        )
    if any(block):
        raise FileError(f"{path}: expected a member or the archive's end at byte {end}, got other bytes")
    return False


def _require_inside(path: Path, entry: tarfile.TarInfo) -> None:
    """Refuse members that are not plain files in the archive, or name a place outside it."""
    parts = re.split(r"[/\\]", entry.name)
    if ".." in parts or not parts[0] or parts[0].endswith(":"):
        raise InvalidInputError(f"{path}: expected members inside the package, got {entry.name!r}")
    if entry.issym() or entry.islnk():
        raise InvalidInputError(f"{path}: {entry.name}: expected a file, got a link to {entry.linkname!r}")
    if not (entry.isfile() or entry.isdir()) or entry.issparse():
        raise InvalidInputError(f"{path}: {entry.name}: expected a plain file, got a device or sparse file")


def _only(path: Path, members: list[Member]) -> Recording:
    """Sort members by recording, of which there must be one; others' sidecars alone are none."""
    found: dict[tuple[str, str], list[tuple[str, Member]]] = {}
    for each in members:
        folder, file = str(Path(each.name).parent), Path(each.name).name
        prefix, kind = _parsed(file) or ("", "")
        found.setdefault((folder, prefix), []).append((kind, each))
    found = {name: parts for name, parts in found.items() if any(map(_is_of_package, parts))}
    if not found:
        raise InvalidInputError(
            f"{path}: expected files like 2024-05-01_rf.raw, _iq.raw, _env.raw and their .yml, got none"
        )
    if len(found) > 1:
        names = ", ".join(f"{folder}/{prefix}".removeprefix("./") for folder, prefix in sorted(found))
        raise InvalidInputError(
            f"{path}: expected one recording, got {len(found)}: {names}: give the raw file of one (of a tar "
            "file: unpack it first)"
        )
    ((_, prefix), parts), *_ = found.items()
    return _sorted(path, prefix, parts)


def _is_of_package(part: tuple[str, Member]) -> bool:
    return _RAW.fullmatch(Path(part[1].name).name) is not None or _has_fields(part[1])


def _sorted(path: Path, prefix: str, parts: list[tuple[str, Member]]) -> Recording:
    tables: dict[str, dict[str, Member]] = {"raw": {}, "settings": {}, "gains": {}}
    sensor = None
    for kind, each in parts:
        if kind == "imu":
            if sensor is not None:
                raise InvalidInputError(f"{path}: expected one of {sensor.name} and {each.name}, got both")
            sensor = each
            continue
        table = "raw" if ".raw" in each.name[-8:] else "gains" if _is_gain(each) else "settings"
        if kind in tables[table]:
            first = tables[table][kind].name
            raise InvalidInputError(f"{path}: expected one of {first} and {each.name}, got both")
        tables[table][kind] = each
    return Recording(path, prefix, tables["raw"], tables["settings"], tables["gains"], sensor)
