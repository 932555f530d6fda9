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


def _axes(*sensors: str, axes: str = "xyz") -> tuple[Names, ...]:
    return tuple(tuple(sensor.replace("?", axis) for axis in axes) for sensor in sensors)


PLAIN_VECTORS = _axes("accelerometer_?_m_s2", "gyroscope_?_rad_s", "magnetometer_?_au")
_VENDOR_VECTORS = _axes("acc_?", "gyr_?", "mag_?")
_REPO_VECTORS = _axes("imu acceleration_?", "imu gyroscope_?", "imu magnetometer_?")
_QUATERNIONS = (*_axes("quaternion_?", "quat_?", axes="wxyz"), *_axes("quat_q?", axes="0123"))
_OPTICAL = _axes("vicon orientation_?", axes="wxyz")
_ANGLES: tuple[Names, ...] = (("roll", "pitch", "yaw"), ("euler_x", "euler_y", "euler_z"))
_MATRIX: Names = tuple(f"mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3))
_TIMES, _TICKS, _COUNTERS = ("time_s", "time (s)"), "sampletimefine", ("packetcounter", "counter")

_VECTOR_GROUPS = (*PLAIN_VECTORS, *_VENDOR_VECTORS, *_REPO_VECTORS)
_GROUPS = (*_VECTOR_GROUPS, *_QUATERNIONS, *_OPTICAL, *_ANGLES, _MATRIX, _COUNTERS, _TIMES, (_TICKS,))
_KNOWN = frozenset(name for names in _GROUPS for name in names)

_MEASURED = re.compile(r"(acc|gyr|mag)[a-z]*[ _.]?([xyz])(?![a-z])", re.ASCII)
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
_MT9 = Claim("NWU", "as the MT9 software's are")


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
            parts = parts.noting(f"{table.left_out} lines of another length or without a digit were left out")
        if table.words:
            parts = parts.noting(f"{table.words} cells hold something else than a number: missing")
        return (_named if table.names else _unnamed)(table, parts, hints or Hints())


def _named(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    dialect = _dialect(table)
    columns = [table.column(name) for name in (*_COUNTERS, _TICKS)]
    times = [column for name in _TIMES if (column := table.column(name)) is not None]
    timed = np.ones(len(table.values), dtype=bool)
    for good in (*map(_is_whole, columns), *map(np.isfinite, times)):
        timed &= good
    if not timed.any():
        raise InvalidInputError("expected lines with a time, got none")
    if untimed := int((~timed).sum()):
        parts = parts.noting(f"{untimed} lines without a time were left out")
    whole = [None if column is None else only(column, timed).astype(np.int64) for column in columns]
    counter, ticks = whole[1] if whole[0] is None else whole[0], whole[2]
    table = replace(table, values=only(table.values, timed))
    parts = _measured(table, parts, dialect, hints)
    if times:
        log = assembled(timeline_of_times(only(times[0], timed), counter), parts)
        told = _gaps_told(table.header, len(log))
        return log if told is None else replace(log, gaps=told)
    rate = _RATE.search("\n".join(table.header))
    rate_hz = number(rate.group(1)) if rate else float("nan")
    period_s = 1.0 / rate_hz if rate_hz > 0.0 else float("nan")
    stamps = Stamps(counter, ticks, dialect.counter_span, dialect.tick_s, period_s)
    return on_clock(stamps, len(table.values), parts, hints)


def _dialect(table: TextTable) -> _Dialect:
    if any(time in table.names for time in _TIMES):
        told = next((match[1] for line in table.header if (match := _WORLD.match(line))), None)
        return _PLAIN if told is None else replace(_PLAIN, claim=Claim(told, "as the file says", final=True))
    return _DOT if any("devicetag" in line.lower() for line in table.header) else _MT_MANAGER


def _is_whole(column: FloatArray | None) -> BoolArray:
    if column is None:
        return np.asarray(True)
    with np.errstate(invalid="ignore"):
        return np.asarray((column >= 0.0) & (column < 2.0**53) & (column == np.floor(column)))


def _measured(table: TextTable, parts: Parts, dialect: _Dialect, hints: Hints) -> Parts:
    found = [table.first(names) for names in zip(PLAIN_VECTORS, _VENDOR_VECTORS, _REPO_VECTORS, strict=True)]
    if found[1] is not None:
        found[1] = found[1] * dialect.gyroscope_to_rad
    odd = _not_understood(table.names, every=dialect not in (_MT_MANAGER, _DOT))
    parts = replace(parts.noting(*odd), vectors=tuple(found))
    if (optical := table.first(_OPTICAL)) is not None:
        note = "orientation: by cameras, in a world of their own whose x and z need not be north and up"
        parts = oriented(parts, _PLAIN.claim, Hints(as_stated=True), optical).noting(note)
    else:
        notations = (table.first(_QUATERNIONS), table.columns(_MATRIX), table.first(_ANGLES))
        parts = oriented(parts, dialect.claim, hints, *notations)
    if all(vectors is None for vectors in (*found, parts.orientations)):
        got = "; ".join(odd) or "got none"
        raise InvalidInputError(
            f"expected columns of acceleration, rate of turn, field or orientation, {got}"
        )
    if found[0] is None and "freeacc_x" in table.names:
        parts = parts.noting("acceleration without gravity is no accelerometer's reading and was left out")
    return parts


def _gaps_told(header: Names, samples: int) -> tuple[Gap, ...] | None:
    """Gaps listed in a plain file, as `write_csv` does; None if it lists none, not even their number."""
    if not any(line.startswith("# gaps:") for line in header):
        return None
    told = [match.groups() for line in header if (match := _GAP.match(line)) is not None]
    gaps = (Gap(int(after), int(lost), number(pause)) for after, lost, pause in told)
    return tuple(gap for gap in gaps if gap.after_index < samples - 1)


def _unnamed(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    """Log of an export of the MT9 software; its kind is told by the number of columns."""
    count = table.values.shape[1]
    for separator in ",;\t" if table.header else "":  # names of which only the time's is known
        names = tuple(cell.strip(' "#').lower() for cell in table.header[-1].split(separator))
        if len(names) == count and any(name in _KNOWN or name.startswith("time") for name in names):
            raise InvalidInputError("; ".join(_not_understood(names, every=True)))
    if count not in (4, 10, 11):  # angles, matrix or vectors, vectors and temperature
        raise InvalidInputError(f"expected 4, 10 or 11 columns where none has a name, got {count}")
    timed = np.isfinite(table.values[:, 0])
    if not timed.any():
        raise InvalidInputError("expected times in the first column, got none")
    time_s, values = table.values[timed, 0], table.values[timed, 1:]
    if count == 4:
        parts = oriented(parts, _MT9, hints, angles_deg=values)
    elif count == 10 and np.mean(are_rotations(values[:_ENOUGH].reshape(-1, 3, 3))) > 0.5:
        parts = oriented(parts.noting("matrices are taken row by row"), _MT9, hints, matrices=values)
    else:
        parts = replace(parts, vectors=(values[:, :3], values[:, 3:6], values[:, 6:9]))
    return assembled(timeline_of_times(time_s), parts)


def _not_understood(names: Names, every: bool) -> Names:
    """Notes on unknown columns, with the known names that they may stand for, and on incomplete groups.

    A program's exports hold many other columns: of theirs, only those that look like a sensor's are listed.
    """
    unknown = [n for n in names if n and n not in _KNOWN and (every or _SENSOR_LIKE.match(n))]
    notes = []
    if unknown:
        more = [f"and {len(unknown) - _MOST_NAMED} more"] if len(unknown) > _MOST_NAMED else []
        notes.append(f"columns not understood: {', '.join([*map(_likely, unknown[:_MOST_NAMED]), *more])}")
    for group in (*_VECTOR_GROUPS, _QUATERNIONS[0]):
        there, missing = ([n for n in group if (n in names) is found] for found in (True, False))
        if missing and there:
            notes.append(f"{', '.join(there)} left out: expected {', '.join(missing)} beside")
    return tuple(notes)


def _likely(name: str) -> str:
    short = name if len(name) <= 40 else f"{name[:40]}..."
    if (match := _MEASURED.match(name)) is None:
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
    target = Path(path)
    part = part_beside(target)
    try:
        clear_parts(target)
        with marked(part):
            part.write_text("\n".join(lines), encoding="utf-8", newline="\n")
            os.replace(part, target)
    except OSError as error:
        raise cannot_write(target, error) from error
    finally:
        part.unlink(missing_ok=True)


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
