"""Logs of the sensor, of whatever kind: the kind is told by the content, never by the name."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import FileError, InvalidInputError
from xsens.logs.bytelogs import parse_stream
from xsens.logs.filekinds import other_kind
from xsens.logs.logparts import Hints
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import parse_text
from xsens.messages.framing import find_frames

__all__ = ["Hints", "parse_stream", "parse_text", "read_log", "write_csv"]

PathLike = str | os.PathLike[str]

MOST_BYTES = 1 << 27
"""Of a log: five hours of raw counts at 256 Hz. Reading takes ten times as much memory, damage 35 times."""

_SNIFFED = 1 << 16
_DAMAGED = 0.01
_TEXT_CONTROLS = np.array([code < 32 and chr(code) not in "\t\n\r\f" for code in range(256)])
"""Which bytes text has none of, but for damage."""

_COLUMNS = {
    "accelerometer_m_s2": "accelerometer_{}_m_s2",
    "gyroscope_rad_s": "gyroscope_{}_rad_s",
    "magnetometer_au": "magnetometer_{}_au",
}


def read_log(path: PathLike, hints: Hints | None = None) -> ImuLog:
    """Read a log: MT9 software ``.bin``, ``.mtb``, raw bytes of a port, or text of any known kind.

    Parameters
    ----------
    path : path
    hints : Hints, optional
        What is known beside the file.

    Returns
    -------
    ImuLog
        Its notes say what was skipped, assumed or not compensated.

    Raises
    ------
    FileError
        If the file cannot be read, is no file, or is larger than `MOST_BYTES`.
    InvalidInputError
        If it holds no samples of the sensor, or not what is needed to understand them.
    """
    data = _content(path)
    if not data:
        raise InvalidInputError(f"{path}: expected a log of the sensor, got an empty file")
    if (other := other_kind(data)) is not None:
        raise InvalidInputError(f"{path}: expected a sensor log (binary or text), got {other}")
    if _is_text(data):
        return parse_text(_text(data), hints, str(path))
    return parse_stream(data, hints, str(path))


def _content(path: PathLike) -> bytes:
    """All bytes of a file of bounded size; never waits on a pipe, never reads from a device."""
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise FileError(f"{path}: expected a file, got something else")
            if found.st_size > MOST_BYTES:
                raise FileError(f"{path}: expected at most {MOST_BYTES} bytes, got {found.st_size}")
            return file.read(found.st_size)
    except FileError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{path}: cannot be read: {reason}") from error


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _is_text(data: bytes) -> bool:
    """Whether hardly any byte is a control character, and no message of the sensor is there."""
    head = np.frombuffer(data[:_SNIFFED], dtype=np.uint8)
    controls = int((_TEXT_CONTROLS[head]).sum())
    return (_is_wide(data) or controls <= _DAMAGED * head.size) and not len(find_frames(head))


def _is_wide(data: bytes) -> bool:
    return data.startswith((b"\xff\xfe", b"\xfe\xff"))


def _text(data: bytes) -> str:
    return data.decode("utf-16" if _is_wide(data) else "utf-8-sig", errors="replace")


def write_csv(path: PathLike, log: ImuLog) -> None:
    """Write samples as a plain comma-separated file, which `read_log` reads back exactly.

    Columns: ``time_s``, ``counter``, ``accelerometer_x_m_s2`` and so on, ``gyroscope_x_rad_s``,
    ``magnetometer_x_au``, ``quaternion_w`` to ``quaternion_z`` (``world_from_sensor``, x magnetic north, z
    up); only those the log has, blank where a sample lacks them. Gaps and notes are comments before them.

    Raises
    ------
    FileError
        If the file cannot be written; then no part of it is left.
    """
    names, columns = _table(log)
    lines = (*_comments(log), ",".join(names), *_lines(columns), "")
    _write_whole(Path(path), "\n".join(lines))


def _table(log: ImuLog) -> tuple[list[str], list[list[str]]]:
    named: list[tuple[str, FloatArray | IntArray]] = [("time_s", log.time_s)]
    if log.counter is not None:
        named.append(("counter", log.counter))
    for attribute, name in _COLUMNS.items():
        vectors = getattr(log, attribute)
        if vectors is not None:
            named += [(name.format(axis), vectors[:, i]) for i, axis in enumerate("xyz")]
    if log.world_from_sensor is not None:
        quaternions = log.world_from_sensor.as_quat(scalar_first=True)
        quaternions[~log.oriented] = np.nan
        named += [(f"quaternion_{axis}", quaternions[:, i]) for i, axis in enumerate("wxyz")]
    return [name for name, _ in named], [_cells(values) for _, values in named]


def _cells(values: FloatArray | IntArray) -> list[str]:
    return ["" if number != number else repr(number) for number in values.tolist()]


def _lines(columns: list[list[str]]) -> Iterator[str]:
    return map(",".join, zip(*columns, strict=True))


def _comments(log: ImuLog) -> Iterator[str]:
    for note in (f"source: {log.source}", *(f"note: {note}" for note in log.notes)):
        yield "# " + " ".join(note.split())
    yield f"# gaps: {len(log.gaps)}"
    for gap in log.gaps:
        yield f"# gap: after sample {gap.after_index}, {gap.lost} lost, {gap.duration_s!r} s"


def _write_whole(path: Path, text: str) -> None:
    """Beside the file, then in its place: it appears whole or not at all."""
    part = path.with_name(f".part-{secrets.token_hex(4)}-{path.name}")
    try:
        part.write_text(text, encoding="utf-8", newline="\n")
        os.replace(part, path)
    except OSError as error:
        raise FileError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
