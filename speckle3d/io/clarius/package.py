"""Files of a Clarius raw package: which there are, raw samples, and the descriptions (yml) beside them.

A package is a tar file, read where it lies, a folder, or a raw file and what is beside it [1]_.

A raw file has a header of five uint32 (id, frames, lines, samples of a line, bytes of a sample); then, by
frame, a uint64 time in nanoseconds and its samples, line by line; all little-endian [1]_. It may be packed by
the program lzop, whose blocks lzallright unpacks [2]_: a packed file is content unpacked in memory while its
frames are read.

The yml is YAML but for its gain curve, ``tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }``, which is left out.
Scalars stay the text that is in the file, so that ``010`` is ten, and every number is read with its unit.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".raw binary layout" and
   ".yml metadata".
.. [2] M. F. X. J. Oberhumer, lzop 1.04, "File format" (lzop.c, `write_header` and `lzo_compress`).
.. [3] clariusdev/research, "Low-Level Parameters" (docs/low-level-parameters.md): `rxFreqShallow`, "start
   demodulation frequency", and `rxFreqDeep`.
"""

import math
import re
import struct
import tarfile
import zlib
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from speckle3d.core.arrays import AnyArray, ComplexArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.files import open_regular
from speckle3d.io.frames import ReadFrame, from_pairs
from speckle3d.io.hdf5 import reading

_NAME = re.compile(
    r"(?!\.)(?:(?P<name>.*)_)?(?P<kind>rf|iq|env|imu)\.(?P<content>raw|ya?ml|tgc)(?:(?<=raw)\.lzo)?"
)
HEADER = struct.Struct("<5I")
_LZOP = b"\x89LZO\0\r\n\x1a\n"
SAMPLES = {"RF": ("<i2", 1, np.int16), "IQ": ("<i2", 2, np.complex64), "envelope": ("u1", 1, np.uint8)}
"""By kind: type of the numbers in the file, how many make a sample, and type of the samples."""

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_SIZES = {"khz": 1e3, "mhz": 1e6, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
"""Of units in Hz and mm."""
_UNITS = {**dict.fromkeys(("", "hz", "mm", "m/s", "°", "deg"), 1.0), **_SIZES}


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


@dataclass(frozen=True)
class Description:
    """The yml of a raw file: fields that are text, lists, or mappings, and their place for messages."""

    fields: dict[str, Any]
    where: str

    @classmethod
    def of(cls, member: Member) -> Self:
        """Parse a YAML document of fields.

        Raises
        ------
        InvalidInputError
            If it is no YAML or holds other things, or PyYAML is not installed.
        """
        yaml, where = extra_module("yaml", "clarius", "a package of a Clarius scanner"), member.where
        text, loader = _GAIN_LINE.sub("", member.text()), getattr(yaml, "CBaseLoader", yaml.BaseLoader)
        with reading(where, Exception):
            fields = yaml.load(text, Loader=loader)
        if not isinstance(fields, dict):
            raise InvalidInputError(f"{where}: expected fields, got a {type(fields).__name__}")
        return cls(fields, where)

    @property
    def kind(self) -> str:
        """Of samples: RF, IQ or envelope by the field `type`, whatever the file is called."""
        packing, text = self.fields.get("compression"), str(self.fields.get("type"))
        kind = _KINDS.get(text.strip().lower())
        if kind is None or packing not in (None, "", "none"):
            raise InvalidInputError(
                f"{self.where}: type: expected {', '.join(_KINDS)}, not compressed, got {text}, {packing}"
            )
        return kind

    @property
    def model(self) -> str:
        """The probe's."""
        probe = self.fields.get("probe") or ""
        return probe if isinstance(probe, str) else str(probe.get("model", ""))

    def number(self, *place: str, of: Any = None) -> float | None:
        """Number of nested fields, as ``60 MHz``, in Hz, mm, m/s or degrees; None where there is none."""
        value = self.fields if of is None else of
        for name in place:
            value = value.get(name) if isinstance(value, dict) else None
        if value in (None, "", "~"):
            return None
        parts = _NUMBER.fullmatch(str(value).replace(",", "."))
        number = math.nan if parts is None else float(parts[1]) * _UNITS.get(parts[2].lower(), math.nan)
        if not math.isfinite(number):
            words = f"{self.where}: {': '.join(place)}"
            raise InvalidInputError(f"{words}: expected a number and its unit, got {value!r:.40}")
        return number

    def require(self, *place: str, of: Any = None) -> float:
        """Number of nested fields that must be there."""
        if (number := self.number(*place, of=of)) is None:
            raise InvalidInputError(f"{self.where}: {': '.join(place)}: expected a number, got none")
        return number

    def elements(self, count: int) -> FloatArray:
        """Element where each line is received; lines that are steered are refused.

        Files may give the first and the last line alone.
        """
        lines = self.fields.get("lines") or ()
        rows = np.array([[self.require(name, of=line) for name in ("rx element", "angle")] for line in lines])
        if len(rows) == 2:
            rows = np.linspace(rows[0], rows[1], count)
        if len(rows) != count:
            raise InvalidInputError(f"{self.where}: lines: expected {count} lines, got {len(rows)}")
        elements, angle_deg = rows.T
        if (oblique := np.flatnonzero(angle_deg)).size:
            raise InvalidInputError(
                f"{self.where}: lines[{oblique[0]}]: angle: expected 0 (lines that are not steered), got "
                f"{angle_deg[oblique[0]]:g} deg, and {oblique.size} of {count} lines steered: record "
                "without steering and Doppler, or give another of its raw files"
            )
        return np.asarray(elements)

    @property
    def receive(self) -> tuple[float, ...] | None:
        """Demodulation frequency at depth 0, Hz, at a depth, and that depth, mm; linear between [3]_.

        None in older files, and where it differs between foci or filters.
        """
        filters = [part for focus in self.fields.get("focus") or () for part in focus.get("receive") or ()]
        names = "shallowfreq", "deepfreq", "filterdepth"
        ends = {tuple(self.require(name, of=part) for name in names) for part in filters}
        return ends.pop() if len(ends) == 1 else None


def open_raw(member: Member, kind: str) -> AnyArray:
    """Frames as they lie in a raw file, unpacked where lzop packed it: ``time`` in ns and ``samples``.

    Samples of a frame have the shape (line, sample, part).

    Raises
    ------
    FileError
        If the file ends early.
    InvalidInputError
        If its samples are of another size than those of the kind.
    """
    dtype, parts, _ = SAMPLES[kind]
    with reading(member.where, struct.error, IndexError):
        content: Any
        if member.name.endswith(".lzo"):
            content = _unpack(member, member.path.stat().st_mtime_ns)
        else:
            content = np.memmap(member.path, np.uint8, "r", member.start, (member.size,))
        _, count, *size, sample_bytes = HEADER.unpack(content[: HEADER.size])
        record = np.dtype([("time", "<u8"), ("samples", dtype, (*size, parts))])
    if sample_bytes != parts * np.dtype(dtype).itemsize:
        raise InvalidInputError(
            f"{member.where}: expected samples of {kind} as in the yml, got some of {sample_bytes} bytes"
        )
    whole = (len(content) - HEADER.size) // record.itemsize
    if whole < count:
        raise FileError(f"{member.where}: ends early: {whole} of {count} frames")
    return np.frombuffer(content, record, count, HEADER.size)


def open_frames(member: Member, kind: str, turns: ComplexArray | None = None) -> ReadFrame:
    """Map or unpack a raw file, whose I/Q are multiplied by `turns`, shape (sample,)."""
    samples = open_raw(member, kind)["samples"]

    def frame(i: int) -> Any:
        echoes = from_pairs(samples[i]) if kind == "IQ" else samples[i][..., 0]
        return echoes if turns is None else echoes * turns

    return frame


@lru_cache(1)
def _unpack(member: Member, _: int) -> bytes:
    lzo = extra_module("lzallright", "clarius", "a file packed by lzop (.lzo)").LZOCompressor
    content, parts = member.read(), list[bytes]()
    if not content.startswith(_LZOP):
        raise InvalidInputError(f"{member.where}: expected a file packed by lzop, got another")
    # Behind mark, versions, method and level: flags, a filter, mode, time, the name and a check sum.
    (flags,) = struct.unpack_from(">I", content, 17)
    at = 37 if flags & 0x800 else 33
    at += 1 + content[at] + 4
    checks = [check for flag, check in ((0x1, zlib.adler32), (0x100, zlib.crc32)) if flags & flag]
    packed_checks = bool(flags & 0x2) + bool(flags & 0x200)
    while any((lengths := content[at : at + 8].ljust(8, b"\0"))[:4]):
        (unpacked_size, size), where = struct.unpack(">II", lengths), f"{member.where}: block {len(parts)}"
        with reading(where, Exception):
            sums = struct.unpack_from(f">{len(checks)}I", content, at + 8)
            at += 8 + 4 * (len(checks) + packed_checks * (size < unpacked_size))
            part = content[at : at + size]
            parts.append(part if size == unpacked_size else bytes(lzo.decompress(part, unpacked_size)))
        if [check(parts[-1]) for check in checks] != [*sums]:
            raise FileError(f"{where}: is damaged: its check sum is another")
        at += size
    return b"".join(parts)
