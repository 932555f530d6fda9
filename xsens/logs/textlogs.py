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
from speckle3d.core.parts import whole_file
from xsens.logs.clocks import Stamps
from xsens.logs.columns import column_of
from xsens.logs.parts import Hints, Parts, assembled
from xsens.logs.samples import VECTORS, ImuLog
from xsens.logs.texttables import Names, TextTable, not_understood, number, read_table
from xsens.logs.worlds import Claim, are_rotations

_SENSOR_LIKE = re.compile(r"acc|gyr|mag|quat|euler|roll|pitch|yaw|time", re.ASCII)
_RATE = re.compile(r"(?:update rate|output ?rate)\s*:[,;\s]*([0-9.e+-]+)\s*hz", re.IGNORECASE)
_WORLD = re.compile(r".*coordinate system\s*:[,;\s]*(ENU|NED|NWU)\b", re.IGNORECASE)
_OWN_WORLD = re.compile(r"# world: (\w+)")
_ENOUGH = 1000
"""Lines that show whether nine numbers are a matrix."""

_SLOWEST_HZ = 5.0
"""An MT Manager's clock of 0.1 ms by which samples come more slowly is a DOT's, of 1 us: at 5 Hz no hand's
movement can be followed."""

_MATRIX = [f"{row}{column}" for row in "123" for column in "123"]


@dataclass(frozen=True)
class _Program:
    """Facts that a program's exports leave out: units, and the world of orientations."""

    claim: Claim
    tick_s: float = 1e-4
    gyroscope_to_rad: float = 1.0
    counter_span: int = 1 << 16


_MT_MANAGER = _Program(Claim("ENU", "the program's default", assumed=True))
_DOT = _Program(Claim("ENU", "as the sensor's are", assumed=True), 1e-6, np.pi / 180.0, 1 << 32)
_PLAIN = _Program(Claim("NWU", "as plain files are"))
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
        parts = (_named if table.names else _mt9_export)(table)
        return assembled(replace(parts, notes=(*table.notes, *parts.notes)), hints or Hints(), source)


def _named(table: TextTable) -> Parts:
    """Samples of a table whose columns have names."""
    stamps = {key: column for key in ("counter", "ticks", "time") if (column := table[key]) is not None}
    timed = np.ones(len(table.values), dtype=bool)
    for key, column in stamps.items():
        timed &= np.isfinite(column)
        if key != "time":
            with np.errstate(invalid="ignore"):
                timed &= (column >= 0.0) & (column < 2.0**53) & (column == np.floor(column))
    if not timed.any():
        raise InvalidInputError("expected lines with a time, got none")
    notes = [] if timed.all() else [f"{(~timed).sum()} lines without a time were left out"]
    table = replace(table, values=table.values if timed.all() else table.values[timed])
    counter, ticks = (
        column[timed].astype(np.int64) if (column := stamps.get(key)) is not None else None
        for key in ("counter", "ticks")
    )
    program = _program(table, counter, ticks)
    if program.tick_s == _DOT.tick_s and not _says_dot(table):
        notes.append("taken for a DOT's export by its clock: ticks of 1 us, gyroscope in deg/s")
    force, rate, field = (table.group(quantity, "xyz") for quantity in ("acc", "gyr", "mag"))
    if rate is not None and not table.states_unit("gyr_x"):
        rate = rate * program.gyroscope_to_rad
    odd = _not_understood(table, "time" in stamps)
    claim: Claim | None = program.claim
    if (own := table.group("optical", "wxyz")) is not None:
        notes.append("orientation: by cameras, in a world of their own: x and z need not be north and up")
        claim = None
    for quantity, axes in (("quat", "wxyz"), ("mat", _MATRIX), ("euler", ("roll", "pitch", "yaw"))):
        own = table.group(quantity, axes) if own is None else own
    if all(part is None for part in (force, rate, field, own)):
        got = "; ".join(odd) or "got none"
        raise InvalidInputError(
            f"expected columns of acceleration, rate of turn, field or orientation, {got}"
        )
    if force is None and "freeacc_x" in table.names:
        notes.append("acceleration without gravity is no accelerometer's reading and was left out")
    told = _RATE.search("\n".join(table.header))
    rate_hz = number(told[1]) if told else float("nan")
    sent = Stamps(
        counter,
        ticks,
        program.counter_span,
        program.tick_s,
        1.0 / rate_hz if rate_hz > 0.0 else float("nan"),
        time_s=table["time"],
    )
    return Parts(sent, (force, rate, field), own, claim, (*odd, *notes))


def _program(table: TextTable, counter: IntArray | None, ticks: IntArray | None) -> _Program:
    """Program that wrote the table; the world is as its header says, if it says one."""
    program = _MT_MANAGER
    if table["time"] is not None:
        program = _PLAIN
    elif _says_dot(table) or _ticks_of_dot(counter, ticks):
        program = _DOT
    for pattern, by, final in ((_OWN_WORLD, "as the file says", True), (_WORLD, "as its header says", False)):
        for line in table.header:
            if match := pattern.match(line):
                return replace(program, claim=Claim(match[1], by, final))
    return program


def _says_dot(table: TextTable) -> bool:
    return any("devicetag" in line.lower() for line in table.header)


def _ticks_of_dot(counter: IntArray | None, ticks: IntArray | None) -> bool:
    """Whether a clock without a header is a DOT's, by how far its samples would be apart."""
    if ticks is None or ticks.size < 2:
        return False
    steps = np.diff(ticks) % (1 << 32)
    counts = np.ones(steps.size) if counter is None else np.maximum(np.diff(counter), 1)
    return bool(np.median(steps / counts) * _MT_MANAGER.tick_s > 1.0 / _SLOWEST_HZ)


def _mt9_export(table: TextTable) -> Parts:
    """Samples of an export of the MT9 software; its kind is told by the number of columns."""
    count = table.values.shape[1]
    if count not in (4, 10, 11):  # angles, matrix or vectors, vectors and temperature
        raise InvalidInputError(
            f"expected columns with names, or the 4, 10 or 11 of an MT9 export without, got {count} without"
        )
    timed = np.isfinite(table.values[:, 0])
    if not timed.any():
        raise InvalidInputError("expected times in the first column, got none")
    stamps, values = Stamps(time_s=table.values[timed, 0]), table.values[timed, 1:]
    if count == 4:
        return Parts(stamps, orientations=values, claim=_MT9)
    if count == 10 and np.mean(are_rotations(values[:_ENOUGH])) > 0.5:
        return Parts(stamps, orientations=values, claim=_MT9, notes=("matrices are taken row by row",))
    return Parts(stamps, (values[:, :3], values[:, 3:6], values[:, 6:9]))


def _not_understood(table: TextTable, plain: bool) -> Names:
    """Note on unknown columns, and on those of a quantity some of whose axes are missing.

    A program's exports hold many other columns: of theirs, only those that look like a sensor's are listed.
    """
    keys = {name: column.key for name in table.names if (column := column_of(name))}
    odd = [name for name in table.names if name not in keys and (plain or _SENSOR_LIKE.match(name))]
    for quantity, axes in (("acc", "xyz"), ("gyr", "xyz"), ("mag", "xyz"), ("quat", "wxyz")):
        there = [name for name, key in keys.items() if key.startswith(f"{quantity}_")]
        odd += there if len(there) < len(axes) else []
    return (not_understood(filter(None, odd)),) if any(odd) else ()


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
    with whole_file(Path(path)) as part:
        part.write_text("\n".join(lines), encoding="utf-8", newline="\n")


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
