"""Read text logs: exports of the MT9 software, MT Manager and Xsens DOT, RepoIMU's, and plain CSV files.

Exports of the MT9 software name no columns: time, then 3 angles; or acceleration, rate of turn, field and
perhaps temperature; or the 9 elements of a matrix. All other files name their columns, in any order, perhaps
with their units. Plain files are written here too.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.parts import cannot_write, clear_parts, marked, part_beside
from xsens.logs.clocks import Stamps, timeline_of_times
from xsens.logs.columns import Names, column_of, suggestion
from xsens.logs.parts import Hints, Parts, are_rotations, assembled, on_clock, only, oriented
from xsens.logs.samples import VECTORS, Gap, ImuLog
from xsens.logs.texttables import TextTable, number, read_table
from xsens.logs.worlds import Claim

_SENSOR_LIKE = re.compile(r"acc|gyr|mag|quat|euler|roll|pitch|yaw|time", re.ASCII)
_MOST_NAMED = 9
_RATE = re.compile(r"(?:update rate|output ?rate)\s*:[,;\s]*([0-9.e+-]+)\s*hz", re.IGNORECASE)
_WORLD = re.compile(r".*coordinate system\s*:[,;\s]*(ENU|NED|NWU)\b", re.IGNORECASE)
_OWN_WORLD = re.compile(r"# world: (\w+)")
_GAP = re.compile(r"# gap: after sample (\d+), (\d+) lost, (\S+) s$")
_ENOUGH = 1000
"""Lines that show whether nine numbers are a matrix."""

_SLOWEST_HZ = 5.0
"""An MT Manager's clock of 0.1 ms by which samples come more slowly is a DOT's, of 1 us: at 5 Hz no hand's
movement can be followed."""


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
        If there is no table, or it holds no samples of one sensor, or they have no time.
    """
    with naming(source):
        table = read_table(StringIO(text, newline=None) if isinstance(text, str) else text)
        parts = Parts(source)
        if table.left_out:
            parts = parts.noting(f"{table.left_out} lines of another length or without a digit were left out")
        if table.words:
            parts = parts.noting(f"{table.words} cells hold something else than a number: missing")
        return (_named if table.names else _unnamed)(table, parts, hints or Hints())


def _named(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    stamps = {key: table.column(key) for key in ("counter", "ticks", "time")}
    timed = np.ones(len(table.values), dtype=bool)
    for key, column in stamps.items():
        if column is not None:
            timed &= np.isfinite(column)
            if key != "time":
                with np.errstate(invalid="ignore"):
                    timed &= (column >= 0.0) & (column < 2.0**53) & (column == np.floor(column))
    if not timed.any():
        raise InvalidInputError("expected lines with a time, got none")
    if untimed := int((~timed).sum()):
        parts = parts.noting(f"{untimed} lines without a time were left out")
    counter, ticks = (
        None if column is None else only(column, timed).astype(np.int64)
        for column in (stamps["counter"], stamps["ticks"])
    )
    time = None if stamps["time"] is None else only(stamps["time"], timed) * table.scale("time")
    dialect = _dialect(table, counter, ticks)
    if dialect.tick_s == _DOT.tick_s and not _says_dot(table):
        parts = parts.noting("taken for a DOT's export by its clock: ticks of 1 us, gyroscope in deg/s")
    parts = _measured(replace(table, values=only(table.values, timed)), parts, dialect, hints)
    told = _RATE.search("\n".join(table.header))
    rate_hz = number(told.group(1)) if told else float("nan")
    if time is not None:
        line = timeline_of_times(time, counter, hints.rate_hz or rate_hz)
        log = assembled(line, parts)
        gaps = _gaps_told(table.header, len(log)) if line.rows is None else None
        return log if gaps is None else replace(log, gaps=gaps)
    period_s = 1.0 / rate_hz if rate_hz > 0.0 else float("nan")
    sent = Stamps(counter, ticks, dialect.counter_span, dialect.tick_s, period_s)
    return on_clock(sent, int(timed.sum()), parts, hints)


def _dialect(table: TextTable, counter: IntArray | None, ticks: IntArray | None) -> _Dialect:
    """Program that wrote the table; the world is as its header says, if it says one."""
    dialect = _MT_MANAGER
    if table.column("time") is not None:
        dialect = _PLAIN
    elif _says_dot(table) or _ticks_of_dot(counter, ticks):
        dialect = _DOT
    if own := next((match[1] for line in table.header if (match := _OWN_WORLD.match(line))), None):
        return replace(dialect, claim=Claim(own, "as the file says", final=True))
    told = next((match[1] for line in table.header if (match := _WORLD.match(line))), None)
    return dialect if told is None else replace(dialect, claim=Claim(told, "as its header says"))


def _says_dot(table: TextTable) -> bool:
    return any("devicetag" in line.lower() for line in table.header)


def _ticks_of_dot(counter: IntArray | None, ticks: IntArray | None) -> bool:
    """Whether a clock without a header is a DOT's, by how far its samples would be apart."""
    if ticks is None or ticks.size < 2:
        return False
    steps = np.diff(ticks) % (1 << 32)
    counts = np.ones(steps.size) if counter is None else np.maximum(np.diff(counter), 1)
    return bool(np.median(steps / counts) * _MT_MANAGER.tick_s > 1.0 / _SLOWEST_HZ)


def _measured(table: TextTable, parts: Parts, dialect: _Dialect, hints: Hints) -> Parts:
    vectors = [_vector(table, quantity, dialect) for quantity in ("acc", "gyr", "mag")]
    odd = _not_understood(table.names, every=dialect.tick_s == _PLAIN.tick_s and "time" in _keys(table))
    parts = replace(parts.noting(*odd), vectors=tuple(vectors))
    if (optical := table.group("optical_{}", "wxyz")) is not None:
        note = "orientation: by cameras, in a world of their own whose x and z need not be north and up"
        parts = oriented(parts, _PLAIN.claim, Hints(as_stated=True), optical).noting(note)
    else:
        matrix = table.group("mat_{}", [f"{row}{column}" for row in "123" for column in "123"])
        angles = table.group("euler_{}", ("roll", "pitch", "yaw"))
        parts = oriented(parts, dialect.claim, hints, table.group("quat_{}", "wxyz"), matrix, angles)
    if all(part is None for part in (*vectors, parts.orientations)):
        got = "; ".join(odd) or "got none"
        raise InvalidInputError(
            f"expected columns of acceleration, rate of turn, field or orientation, {got}"
        )
    if vectors[0] is None and "freeacc_x" in table.names:
        parts = parts.noting("acceleration without gravity is no accelerometer's reading and was left out")
    return parts


def _keys(table: TextTable) -> list[str]:
    return [column.key for column in table.columns]


def _vector(table: TextTable, quantity: str, dialect: _Dialect) -> FloatArray | None:
    """Readings of a sensor in SI units; None if an axis is missing."""
    rows = table.group(f"{quantity}_{{}}", "xyz")
    if rows is None:
        return None
    usual = dialect.gyroscope_to_rad if quantity == "gyr" else 1.0
    scales = [table.scale(f"{quantity}_{axis}") for axis in "xyz"]
    factors = np.array([usual if scale is None else scale for scale in scales])
    with np.errstate(over="ignore"):  # damage, which is left out as no measurement
        return rows if (factors == 1.0).all() else rows * factors


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
    if count not in (4, 10, 11):  # angles, matrix or vectors, vectors and temperature
        raise InvalidInputError(
            f"expected columns with names, or the 4, 10 or 11 of an MT9 export without, got {count} without"
        )
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
    columns = {name: column_of(name) for name in names if name}
    unknown = [n for n, column in columns.items() if column is None and (every or _SENSOR_LIKE.match(n))]
    notes = []
    if unknown:
        more = [f"and {len(unknown) - _MOST_NAMED} more"] if len(unknown) > _MOST_NAMED else []
        listed = ", ".join([*map(suggestion, unknown[:_MOST_NAMED]), *more])
        notes.append(f"columns not understood: {listed}")
    keys = {column.key for column in columns.values() if column is not None}
    for kind, axes in (("acc", "xyz"), ("gyr", "xyz"), ("mag", "xyz"), ("quat", "wxyz")):
        missing = [axis for axis in axes if f"{kind}_{axis}" not in keys]
        if missing and len(missing) < len(axes):
            found = ", ".join(n for n, c in columns.items() if c is not None and c.key.startswith(f"{kind}_"))
            notes.append(f"{found} left out: expected {', '.join(missing)} beside")
    return tuple(notes)


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
    for vectors in VECTORS:
        if (values := getattr(log, vectors)) is not None:
            sensor, _, unit = vectors.partition("_")
            yield from zip([f"{sensor}_{axis}_{unit}" for axis in "xyz"], values.T, strict=True)
    if log.world_from_sensor is not None:
        quaternions = log.world_from_sensor.as_quat(scalar_first=True)
        quaternions[~log.oriented] = np.nan
        yield from zip([f"quaternion_{axis}" for axis in "wxyz"], quaternions.T, strict=True)


def _comments(log: ImuLog) -> Iterator[str]:
    for note in (f"source: {log.source}", *(f"note: {note}" for note in log.notes)):
        yield "# " + " ".join(note.split())
    if log.world_from_sensor is not None:
        yield "# world: NWU (x magnetic north, y west, z up)"
    yield f"# gaps: {len(log.gaps)}"
    for gap in log.gaps:
        yield f"# gap: after sample {gap.after_index}, {gap.lost} lost, {gap.duration_s!r} s"
