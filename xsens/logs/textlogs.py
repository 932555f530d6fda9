"""Read text logs: exports of the MT9 software, MT Manager and Xsens DOT, RepoIMU's, and plain CSV files.

Exports of the MT9 software name no columns: time, then 3 angles; or acceleration, rate of turn, field and
perhaps temperature; or the 9 elements of a matrix. All other files name their columns, in any order.
Plain files are written here too.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.parts import cannot_write, clear_parts, marked, part_beside
from xsens.logs.clocks import Stamps, timeline_of_times
from xsens.logs.parts import Hints, Parts, are_rotations, assembled, on_clock, only, oriented
from xsens.logs.samples import VECTORS, Gap, ImuLog
from xsens.logs.texttables import Names, TextTable, number, read_table
from xsens.logs.worlds import Claim


def _named_xyz(*sensors: str) -> tuple[Names, ...]:
    return tuple(tuple(sensor.replace("?", axis) for axis in "xyz") for sensor in sensors)


PLAIN_VECTORS = _named_xyz("accelerometer_?_m_s2", "gyroscope_?_rad_s", "magnetometer_?_au")
_VENDOR_VECTORS = _named_xyz("acc_?", "gyr_?", "mag_?")
_REPO_VECTORS = _named_xyz("imu acceleration_?", "imu gyroscope_?", "imu magnetometer_?")
_QUATERNIONS: tuple[Names, ...] = (
    ("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),
    ("quat_q0", "quat_q1", "quat_q2", "quat_q3"),
    ("quat_w", "quat_x", "quat_y", "quat_z"),
)
_OPTICAL: Names = tuple(f"vicon orientation_{axis}" for axis in "wxyz")
_ANGLES: tuple[Names, ...] = (("roll", "pitch", "yaw"), ("euler_x", "euler_y", "euler_z"))
_MATRIX: Names = tuple(f"mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3))
_TIMES, _TICKS = ("time_s", "time (s)"), "sampletimefine"
_COUNTERS = ("packetcounter", "counter")

_GROUPS = (*PLAIN_VECTORS, *_VENDOR_VECTORS, *_REPO_VECTORS, *_QUATERNIONS, _OPTICAL, *_ANGLES, _MATRIX)
_KNOWN = frozenset(name for names in (*_GROUPS, _COUNTERS, _TIMES, (_TICKS,)) for name in names)

_MEASURED = re.compile(r"(acc|gyr|mag)[a-z]*(?:[ _.]?([xyz])(?![a-z]))?", re.ASCII)
_SENSOR_LIKE = re.compile(r"acc|gyr|mag|quat|euler|roll|pitch|yaw|time", re.ASCII)
_MOST_NAMED = 9
_RATE = re.compile(r"(?:update rate|output ?rate)\s*:[,;\s]*([0-9.e+-]+)\s*hz", re.IGNORECASE)
_WORLD = re.compile(r"# world: (\w+)")
_GAP = re.compile(r"# gap: after sample (\d+), (\d+) lost, (\S+) s$")
_ENOUGH = 1000
"""Lines that show whether nine numbers are a matrix."""


@dataclass(frozen=True)
class _Dialect:
    """Facts that a program's exports leave out: units, and the world of orientations."""

    claim: Claim
    tick_s: float = 1e-4
    gyroscope_to_rad: float = 1.0
    counter_span: int = 1 << 16


_MT_MANAGER = _Dialect(Claim("ENU", "the program's default", assumed=True))
_DOT = _Dialect(Claim("ENU", "as the sensor's are", assumed=True), 1e-6, np.pi / 180.0, 1 << 32)
_PLAIN = _Dialect(Claim("NWU", "as plain files are"))
_MT9 = _Dialect(Claim("NWU", "as the MT9 software's are"))


def parse_text(text: str | Iterable[str], hints: Hints | None = None, source: str = "text") -> ImuLog:
    """Read the samples in a table of numbers.

    Parameters
    ----------
    text : str, or iterable of str
        Lines, if it is not one string.
    hints : Hints, optional
    source : str
        Name of the text in errors.

    Raises
    ------
    InvalidInputError
        If there is no table, or it holds no samples of the sensor, or they have no time.
    """
    with naming(source):
        table = read_table(StringIO(text, newline=None) if isinstance(text, str) else text, _KNOWN)
        parts = Parts(source)
        if table.left_out:
            parts = parts.noting(
                f"{table.left_out} lines of another length or without a number were left out"
            )
        if table.words:
            parts = parts.noting(f"{table.words} cells hold something else than a number: missing")
        read = _named if table.names else _unnamed
        return read(table, parts, hints or Hints())


def _dialect(table: TextTable) -> _Dialect:
    if any(time in table.names for time in _TIMES):
        told = next((match[1] for line in table.header if (match := _WORLD.match(line))), None)
        return _PLAIN if told is None else replace(_PLAIN, claim=Claim(told, "as the file says", final=True))
    return _DOT if any("devicetag" in line.lower() for line in table.header) else _MT_MANAGER


def _named(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    dialect = _dialect(table)
    table, untimed = _timed(table)
    if untimed:
        parts = parts.noting(f"{untimed} lines without a time were left out")
    parts = _measured(table, parts, dialect, hints)
    counter = next((c for name in _COUNTERS if (c := _whole(table.column(name))) is not None), None)
    time_s = table.first((name,) for name in _TIMES)
    if time_s is not None:
        log = assembled(timeline_of_times(time_s[:, 0], counter), parts)
        told = _gaps_told(table.header, len(log))
        return log if told is None else replace(log, gaps=told)
    rate = _RATE.search("\n".join(table.header))
    rate_hz = number(rate.group(1)) if rate else float("nan")
    period_s = 1.0 / rate_hz if rate_hz > 0.0 else float("nan")
    ticks = _whole(table.column(_TICKS))
    stamps = Stamps(counter, ticks, dialect.counter_span, dialect.tick_s, period_s)
    return on_clock(stamps, len(table.values), lambda: parts, hints)


def _timed(table: TextTable) -> tuple[TextTable, int]:
    """Lines that lack no counter or time, and how many others there are."""
    good = np.ones(len(table.values), dtype=bool)
    for name in (*_COUNTERS, _TICKS):
        good &= _is_whole(table.column(name))
    for name in _TIMES:
        time_s = table.column(name)
        good &= True if time_s is None else np.isfinite(time_s)
    if not good.any():
        raise InvalidInputError("expected lines with a time, got none")
    return replace(table, values=only(table.values, good)), int((~good).sum())


def _is_whole(column: FloatArray | None) -> BoolArray:
    if column is None:
        return np.asarray(True)
    with np.errstate(invalid="ignore"):
        return np.asarray((column >= 0.0) & (column < 2.0**53) & (column == np.floor(column)))


def _whole(column: FloatArray | None) -> IntArray | None:
    return None if column is None else column.astype(np.int64)


def _measured(table: TextTable, parts: Parts, dialect: _Dialect, hints: Hints) -> Parts:
    found = [table.first(names) for names in zip(PLAIN_VECTORS, _VENDOR_VECTORS, _REPO_VECTORS, strict=True)]
    odd = _not_understood(table.names, dialect is not _MT_MANAGER and dialect is not _DOT)
    odd = (*odd, *_incomplete(table.names, (*PLAIN_VECTORS, *_VENDOR_VECTORS, *_QUATERNIONS[:1])))
    if found[1] is not None:
        found[1] = found[1] * dialect.gyroscope_to_rad
    parts = replace(parts.noting(*odd), vectors=tuple(found))
    if (optical := table.columns(*_OPTICAL)) is not None:
        note = "orientation: by cameras, in a world of their own whose x and z need not be north and up"
        parts = oriented(parts, _PLAIN.claim, Hints(as_stated=True), optical).noting(note)
    else:
        notations = (table.first(_QUATERNIONS), table.columns(*_MATRIX), table.first(_ANGLES))
        parts = oriented(parts, dialect.claim, hints, *notations)
    if all(vectors is None for vectors in (*found, parts.orientations)):
        got = "; ".join(odd) or "got none"
        raise InvalidInputError(
            f"expected columns of acceleration, rate of turn, field or orientation, {got}"
        )
    if found[0] is None and "freeacc_x" in table.names:
        parts = parts.noting("acceleration without gravity is no accelerometer's reading and was left out")
    return parts


def _gaps_told(header: tuple[str, ...], samples: int) -> tuple[Gap, ...] | None:
    """Gaps listed in a plain file, as `write_csv` does; None if it lists none, not even their number."""
    if not any(line.startswith("# gaps:") for line in header):
        return None
    told = [match.groups() for line in header if (match := _GAP.match(line)) is not None]
    gaps = (Gap(int(after), int(lost), number(pause)) for after, lost, pause in told)
    return tuple(gap for gap in gaps if gap.after_index < samples - 1)


def _unnamed(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    """Log of an export of the MT9 software; its kind is told by the number of columns."""
    count = table.values.shape[1]
    _require_unnamed(table, count)
    if count not in (4, 10, 11):  # angles, matrix or vectors, vectors and temperature
        raise InvalidInputError(f"expected 4, 10 or 11 columns where none has a name, got {count}")
    timed = np.isfinite(table.values[:, 0])
    if not timed.any():
        raise InvalidInputError("expected times in the first column, got none")
    time_s, values = table.values[timed, 0], table.values[timed, 1:]
    return assembled(timeline_of_times(time_s), _of_mt9(values, parts, hints))


def _require_unnamed(table: TextTable, count: int) -> None:
    """Refuse columns that have names of which only the time is known."""
    for line in table.header[-1:]:
        for separator in ",;\t":
            names = tuple(cell.strip().strip('"').lower() for cell in line.lstrip("# ").split(separator))
            if len(names) == count and any(name in _KNOWN or name.startswith("time") for name in names):
                raise InvalidInputError("; ".join(_not_understood(names, plain=True)))


def _of_mt9(values: FloatArray, parts: Parts, hints: Hints) -> Parts:
    if values.shape[1] == 3:
        return oriented(parts, _MT9.claim, hints, angles_deg=values)
    if values.shape[1] == 9 and np.mean(are_rotations(values[:_ENOUGH].reshape(-1, 3, 3))) > 0.5:
        note = "matrices are taken row by row: nothing in this file can tell"
        return oriented(parts.noting(note), _MT9.claim, hints, matrices=values)
    return replace(parts, vectors=(values[:, :3], values[:, 3:6], values[:, 6:9]))


# -- columns that are not understood


def _not_understood(names: Names, plain: bool) -> tuple[str, ...]:
    """Note that lists unknown columns, with the known names that they may stand for.

    All are listed if the file is a `plain` one. A program's exports hold many other columns: of theirs, only
    names that look like a sensor's are listed. Names are in lower case.
    """
    unknown = [name for name in names if name and name not in _KNOWN]
    if not plain:
        unknown = [name for name in unknown if _SENSOR_LIKE.match(name)]
    if not unknown:
        return ()
    named = [_with_likely(name) for name in unknown[:_MOST_NAMED]]
    more = (f"and {len(unknown) - _MOST_NAMED} more",) if len(unknown) > _MOST_NAMED else ()
    return (f"columns not understood: {', '.join((*named, *more))}",)


def _incomplete(names: Names, groups: Iterable[Names]) -> tuple[str, ...]:
    """Notes on columns that were left out because others of their group are missing."""
    notes = []
    for group in groups:
        missing = [name for name in group if name not in names]
        there = [name for name in group if name in names]
        if missing and there:
            notes.append(f"{', '.join(there)} left out: expected {', '.join(missing)} beside")
    return tuple(notes)


def _with_likely(name: str) -> str:
    short = name if len(name) <= 40 else f"{name[:40]}..."
    match = _MEASURED.match(name)
    if match is None or match[2] is None:
        return short
    group = next(names for names in PLAIN_VECTORS if names[0].startswith(match[1]))
    return f"{short} (expected {group['xyz'.index(match[2])]})"


# -- writing


def write_csv(path: str | os.PathLike[str], log: ImuLog) -> None:
    """Write samples as a plain comma-separated file, which `read_log` reads back exactly.

    Columns: ``time_s``, ``counter``, ``accelerometer_x_m_s2`` and so on, ``gyroscope_x_rad_s``,
    ``magnetometer_x_au``, ``quaternion_w`` to ``quaternion_z`` (``world_from_sensor``, x magnetic north, z
    up); only those the log has, blank where a sample lacks them. Gaps and notes are comments before them.

    Parameters
    ----------
    path : path
    log : ImuLog

    Raises
    ------
    FileError
        If the file cannot be written; then no part of it is left.

    Examples
    --------
    >>> import os, tempfile, numpy as np, xsens
    >>> log = xsens.ImuLog(np.array([0.0, 0.01]), gyroscope_rad_s=np.full((2, 3), 0.1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "log.csv")
    ...     xsens.write_csv(path, log)
    ...     xsens.read_log(path).rate_hz
    100.0
    """
    names, columns = zip(*_csv_columns(log), strict=True)
    cells = [["" if number != number else repr(number) for number in values.tolist()] for values in columns]
    lines = (*_comments(log), ",".join(names), *map(",".join, zip(*cells, strict=True)), "")
    _write_whole(Path(path), "\n".join(lines))


def _csv_columns(log: ImuLog) -> Iterator[tuple[str, FloatArray | IntArray]]:
    yield "time_s", log.time_s
    if log.counter is not None:
        yield "counter", log.counter
    for names, vectors in zip(PLAIN_VECTORS, VECTORS, strict=True):
        if (values := getattr(log, vectors)) is not None:
            yield from zip(names, values.T, strict=True)
    if log.world_from_sensor is not None:
        quaternions = log.world_from_sensor.as_quat(scalar_first=True)
        quaternions[~log.oriented] = np.nan
        yield from zip(_QUATERNIONS[0], quaternions.T, strict=True)


def _comments(log: ImuLog) -> Iterator[str]:
    for note in (f"source: {log.source}", *(f"note: {note}" for note in log.notes)):
        yield "# " + " ".join(note.split())
    if log.world_from_sensor is not None:
        yield "# world: NWU (x magnetic north, y west, z up)"
    yield f"# gaps: {len(log.gaps)}"
    for gap in log.gaps:
        yield f"# gap: after sample {gap.after_index}, {gap.lost} lost, {gap.duration_s!r} s"


def _write_whole(path: Path, text: str) -> None:
    """Write beside the file, then rename, so that it appears whole or not at all."""
    part = part_beside(path)
    try:
        clear_parts(path)
        with marked(part):
            part.write_text(text, encoding="utf-8", newline="\n")
            os.replace(part, path)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        part.unlink(missing_ok=True)
