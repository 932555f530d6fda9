"""Logs as text: exports of the MT9 software, of MT Manager and of Xsens DOT, and plain comma-separated files.

The MT9 software's name no columns: time, then 3 angles; or acceleration, rate of turn, field and perhaps
temperature; or 9 of a matrix. All others name theirs, which come in any order.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, naming
from xsens.logs.clocks import Stamps, timeline_of_times
from xsens.logs.columnnames import PLAIN_VECTORS, Names, incomplete, not_understood
from xsens.logs.logparts import TRANSPOSED, Hints, Parts, assembled, on_clock
from xsens.logs.samples import Gap, ImuLog
from xsens.logs.texttables import TextTable, read_table
from xsens.logs.worlds import (
    Orientations,
    are_rotations,
    from_angles,
    from_matrices,
    from_quaternions,
    rows_or_columns,
)

_VENDOR_VECTORS: tuple[Names, ...] = tuple(
    tuple(f"{sensor}_{axis}" for axis in "xyz") for sensor in ("acc", "gyr", "mag")
)
_QUATERNIONS: tuple[Names, ...] = (
    ("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),
    ("quat_q0", "quat_q1", "quat_q2", "quat_q3"),
    ("quat_w", "quat_x", "quat_y", "quat_z"),
)
_ANGLES: tuple[Names, ...] = (("roll", "pitch", "yaw"), ("euler_x", "euler_y", "euler_z"))
_MATRIX: Names = tuple(f"mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3))
_TIME, _TICKS = "time_s", "sampletimefine"
_COUNTERS = ("packetcounter", "counter")

_ALL = (*PLAIN_VECTORS, *_VENDOR_VECTORS, *_QUATERNIONS, *_ANGLES, _MATRIX, _COUNTERS, (_TIME, _TICKS))
_KNOWN = frozenset(name for names in _ALL for name in names)

_RATE = re.compile(r"(?:update rate|output ?rate)\s*:[,;\s]*([0-9.]+)\s*hz", re.IGNORECASE)
_GAP = re.compile(r"# gap: after sample (\d+), (\d+) lost, (\S+) s$")
_ENOUGH = 1000
"""Lines that show whether nine numbers are a matrix."""

_MT9_COLUMNS = {4: "angles", 10: "matrix or vectors", 11: "vectors"}


@dataclass(frozen=True)
class _Dialect:
    """What a program's exports do not say: units, and the world of orientations."""

    tick_s: float = 1e-4
    gyroscope_to_rad: float = 1.0
    counter_span: int = 1 << 16
    world: str = "ENU"
    notes: tuple[str, ...] = ()


_MT_MANAGER = _Dialect(notes=("orientation: taken as seen from east, north, up, the program's default",))
_DOT = _Dialect(
    1e-6,
    np.pi / 180.0,
    1 << 32,
    notes=("orientation: taken as seen from east, north, up, as the sensor's are",),
)
_PLAIN = _Dialect(world="NWU")


def parse_text(text: str, hints: Hints | None = None, source: str = "text") -> ImuLog:
    """Samples in a table of numbers.

    Parameters
    ----------
    text : str
    hints : Hints, optional
    source : str
        What to call it in errors.

    Raises
    ------
    InvalidInputError
        If there is no table, or it holds no samples of the sensor, or they have no time.
    """
    with naming(source):
        table = read_table(text, _KNOWN)
        out = table.left_out
        parts = Parts(source, (f"{out} lines of another length were left out",) if out else ())
        return (
            _named(table, parts, hints or Hints())
            if table.names
            else _unnamed(table, parts, hints or Hints())
        )


def _dialect(table: TextTable) -> _Dialect:
    if _TIME in table.names:
        return _PLAIN
    return _DOT if any("devicetag" in line.lower() for line in table.header) else _MT_MANAGER


def _named(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    dialect = _dialect(table)
    table, untimed = _timed(table)
    if untimed:
        parts = parts.noting(f"{untimed} lines without a time were left out")
    parts = _measured(table, parts, dialect, hints)
    counter = _whole(_first(table, _COUNTERS))
    time_s = table.column(_TIME)
    if time_s is not None:
        log = assembled(timeline_of_times(time_s, counter), parts)
        told = _gaps_told(table.header, len(log))
        return log if told is None else replace(log, gaps=told)
    rate = _RATE.search("\n".join(table.header))
    period_s = _period(rate.group(1)) if rate else float("nan")
    ticks = _whole(table.column(_TICKS))
    stamps = Stamps(counter, ticks, dialect.counter_span, dialect.tick_s, period_s)
    return on_clock(stamps, len(table.values), parts, hints)


def _period(rate_hz: str) -> float:
    try:
        return 1.0 / float(rate_hz)
    except (ValueError, ZeroDivisionError):
        return float("nan")


def _first(table: TextTable, names: Names) -> FloatArray | None:
    return next((column for name in names if (column := table.column(name)) is not None), None)


def _timed(table: TextTable) -> tuple[TextTable, int]:
    """Lines whose stamps are all there, and how many others there are."""
    good = np.ones(len(table.values), dtype=bool)
    for name in (*_COUNTERS, _TICKS):
        good &= _is_whole(table.column(name))
    time_s = table.column(_TIME)
    good &= True if time_s is None else np.isfinite(time_s)
    if not good.any():
        raise InvalidInputError("expected lines with a time, got none")
    return replace(table, values=table.values[good]), int((~good).sum())


def _is_whole(column: FloatArray | None) -> BoolArray:
    if column is None:
        return np.asarray(True)
    with np.errstate(invalid="ignore"):
        return np.asarray((column >= 0.0) & (column < 2.0**53) & (column == np.floor(column)))


def _whole(column: FloatArray | None) -> IntArray | None:
    return None if column is None else column.astype(np.int64)


def _measured(table: TextTable, parts: Parts, dialect: _Dialect, hints: Hints) -> Parts:
    found = [
        next((v for names in both if (v := table.columns(*names)) is not None), None)
        for both in zip(PLAIN_VECTORS, _VENDOR_VECTORS, strict=True)
    ]
    orientations, notes = _orientations(table, found[0], hints.world or dialect.world)
    odd = not_understood(table.names, _KNOWN, dialect is _PLAIN)
    odd = (*odd, *incomplete(table.names, (*PLAIN_VECTORS, *_VENDOR_VECTORS, *_QUATERNIONS[:1])))
    if all(vectors is None for vectors in (*found, orientations)):
        got = "; ".join(odd) or "got none"
        raise InvalidInputError(
            f"expected columns of acceleration, rate of turn, field or orientation, {got}"
        )
    notes = (*odd, *notes)
    if orientations is not None and hints.world is None:
        notes = (*notes, *dialect.notes)
    if found[0] is None and "freeacc_x" in table.names:
        notes = (*notes, "acceleration without gravity is no accelerometer's reading and was left out")
    if found[1] is not None:
        found[1] = found[1] * dialect.gyroscope_to_rad
    return replace(_with_vectors(parts, *found), orientations=orientations).noting(*notes)


def _with_vectors(
    parts: Parts, acceleration: FloatArray | None, rate: FloatArray | None, field: FloatArray | None
) -> Parts:
    return replace(parts, accelerometer_m_s2=acceleration, gyroscope_rad_s=rate, magnetometer_au=field)


def _orientations(
    table: TextTable, acceleration: FloatArray | None, world: str
) -> tuple[Orientations | None, tuple[str, ...]]:
    for names in _QUATERNIONS:
        if (quaternions := table.columns(*names)) is not None:
            return from_quaternions(quaternions, world), ()
    if (flat := table.columns(*_MATRIX)) is not None:
        return _of_matrices(flat, acceleration, world)
    for names in _ANGLES:
        if (angles := table.columns(*names)) is not None:
            return from_angles(angles, world), ()
    return None, ()


def _of_matrices(
    flat: FloatArray, acceleration: FloatArray | None, world: str
) -> tuple[Orientations, tuple[str, ...]]:
    matrices, turned = rows_or_columns(flat.reshape(-1, 3, 3), acceleration)
    return from_matrices(matrices, world), ((TRANSPOSED,) if turned else ())


def _gaps_told(header: tuple[str, ...], samples: int) -> tuple[Gap, ...] | None:
    """Gaps that a plain file tells, as `xsens.logs.read.write_csv` writes them; None if it does not."""
    if not any(line.startswith("# gaps:") for line in header):
        return None
    told = [match.groups() for line in header if (match := _GAP.match(line)) is not None]
    gaps = (Gap(int(after), int(lost), _seconds(pause)) for after, lost, pause in told)
    return tuple(gap for gap in gaps if gap.after_index < samples - 1)


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _unnamed(table: TextTable, parts: Parts, hints: Hints) -> ImuLog:
    """The MT9 software's exports, told apart by how many columns they have."""
    count = table.values.shape[1]
    _require_unnamed(table, count)
    if count not in _MT9_COLUMNS:
        raise InvalidInputError(f"expected 4, 10 or 11 columns where none has a name, got {count}")
    timed = np.isfinite(table.values[:, 0])
    if not timed.any():
        raise InvalidInputError("expected times in the first column, got none")
    time_s, values = table.values[timed, 0], table.values[timed, 1:]
    return assembled(timeline_of_times(time_s), _mt9(values, parts, hints.world or "NWU"))


def _require_unnamed(table: TextTable, count: int) -> None:
    """Refuse columns that have names, but none that is known besides the time."""
    for line in table.header[-1:]:
        for separator in ",;\t":
            names = tuple(cell.strip().strip('"').lower() for cell in line.lstrip("# ").split(separator))
            if len(names) == count and any(name in _KNOWN or name.startswith("time") for name in names):
                raise InvalidInputError("; ".join(not_understood(names, _KNOWN, plain=True)))


def _mt9(values: FloatArray, parts: Parts, world: str) -> Parts:
    if values.shape[1] == 3:
        return replace(parts, orientations=from_angles(values, world))
    if values.shape[1] == 9 and np.mean(are_rotations(values[:_ENOUGH].reshape(-1, 3, 3))) > 0.5:
        orientations, _ = _of_matrices(values, None, world)
        note = "matrices are taken row by row: nothing in this file can tell"
        return replace(parts, orientations=orientations).noting(note)
    return _with_vectors(parts, values[:, :3], values[:, 3:6], values[:, 6:9])
