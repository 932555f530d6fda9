"""Read text logs: exports of the MT9 software, MT Manager and Xsens DOT, RepoIMU's, and plain CSV files.

Exports of the MT9 software name no columns: time, then 3 angles; or acceleration, rate of turn, field and
perhaps temperature; or the 9 elements of a matrix. All other files name their columns, in any order, perhaps
with their units. Plain files are written here too.
"""

import re
from collections.abc import Iterable
from io import StringIO
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike, whole_file
from xsens.logs.assembly import (
    Claim,
    Hints,
    Parts,
    are_rotations,
    assemble_log,
    quaternions_of,
    rotation_vectors,
)
from xsens.logs.clocks import SHORTEST_S, TICK_S, Stamps, usual_step
from xsens.logs.samples import VECTORS, ImuLog, median_norm
from xsens.logs.texttables import (
    STAMPS,
    TIMES,
    TextTable,
    column_of,
    describe_unknown,
    number,
    read_table,
    unwrap_column,
)

_SENSOR_LIKE = re.compile("acc|gyr|mag|quat|euler|roll|pitch|yaw|time")
_EQUALS = r"\s*[:=,;][,;\s]*"
_RATE = re.compile(
    r"(?:update|output|sampl(?:e|ing)|data)[ _]?(?:rate|frequency)(?:[ _]?\(?hz\)?)?"
    rf"{_EQUALS}([0-9.]+)(?![0-9.]|\s*[kmuµs])",
    re.IGNORECASE,
)
_WORLD = re.compile(
    rf"(# world|.*\b(?:coordinate ?system|frame|world)){_EQUALS}(ENU|NED|NWU)\b", re.IGNORECASE
)
"""What names the orientation's world; nothing outweighs a plain file's."""

_ENOUGH = 1000
"""Lines that show whether nine numbers are a matrix."""

_TICKS = {"MT Manager": TICK_S, "DOT": 1e-6}
"""Ticks of the programs' clocks, s."""

_SLOWEST_HZ = 5.0
"""By times that come more slowly no hand's movement can be followed: they are in another unit."""

_EPOCH_S = (1e9, 4e9)
"""Seconds since 1970 of the years 2001 to 2096."""

_LARGEST = 2.0**53
"""Larger numbers count nothing: they are not whole."""

_HALF_TURN = 3.2
"""Angles that are none of them larger may be in radians."""

_GRAVITY_M_S2 = 4.0
"""Median length of accelerations from which they hold gravity: a hand's own are less."""

_AXES = {
    **dict.fromkeys(("acc", "gyr", "mag", "free", "dv"), "xyz"),
    **dict.fromkeys(("dq", "optical", "quat"), "wxyz"),
    "mat": [f"{row}_{column}" for row in "123" for column in "123"],
    "euler": "xyz",
}
_ORIENTATIONS = ("optical", "quat", "mat", "euler")


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
        hints = hints or Hints()
        return assemble_log(_samples(table, hints.rate_hz), hints, source)


def _samples(table: TextTable, rate_hz: float | None) -> Parts:
    """Samples of a table whose columns are known, at a rate that the header may name."""
    notes = list(table.notes)
    columns, stamps, dot = _stamps(table, rate_hz, notes)
    readings = {}
    for quantity, axes in _AXES.items():
        keys = [f"{quantity}_{axis}" for axis in axes]
        if columns.keys() >= set(keys):
            readings[quantity] = np.column_stack([columns[key] for key in keys])
    if not table.names and "mag" in readings:
        numbers = np.hstack([*readings.values()])
        if np.mean(are_rotations(numbers[:_ENOUGH])) > 0.5:
            readings = {"mat": numbers}
            notes.append("matrices are taken row by row")
    if dot and "gyr" in readings and table.scales["gyr_x"] is None:
        readings["gyr"] = np.deg2rad(readings["gyr"])
    free = readings.pop("free", None)
    if "acc" not in readings and free is not None:
        if median_norm(free) >= _GRAVITY_M_S2:
            readings["acc"] = free
        else:
            notes.append("acceleration without gravity is no accelerometer's reading and was left out")
    odd = _unknown_columns(table)
    if not readings:
        text = "; ".join(odd) or describe_unknown(table.names)
        raise InvalidInputError(
            f"expected columns of acceleration, rate of turn, field or orientation, {text}"
        )
    notation = next(filter(readings.__contains__, _ORIENTATIONS), "")
    claim: Claim | None = _claim(table, dot)
    notations = {"": quaternions_of(readings[notation])} if notation else {}
    if notation == "optical":
        claim = None
        notes.append("orientation: by cameras, in a world of their own: x and z need not be north and up")
    elif notation == "quat":
        notations["the scalar is the last number"] = np.roll(notations[""], 1, axis=1)
    elif notation == "euler" and "time" in table.columns and table.scales["euler_x"] is None:
        angles = readings["euler"]
        if np.nanmax(np.abs(angles), initial=0.0) < _HALF_TURN:
            notations["angles are in radians"] = quaternions_of(np.degrees(angles))
        if len(notations) > 1 and "acc" not in readings:
            raise InvalidInputError("expected angles with their unit, as roll_deg, got small ones without")
    if "dq" in readings:
        readings["dq"] = rotation_vectors(readings["dq"])
    vectors, increments = (
        {
            name: readings[quantity]
            for name, quantity in zip(VECTORS, quantities, strict=False)
            if quantity in readings
        }
        for quantities in (("acc", "gyr", "mag"), ("dv", "dq"))
    )
    return Parts(stamps, vectors, notations, claim, (*odd, *notes), increments)


def _stamps(
    table: TextTable, rate_hz: float | None, notes: list[str]
) -> tuple[dict[str, FloatArray], Stamps, bool]:
    """Columns without the lines that have no time, their stamps, and whether they are a DOT's."""
    columns = dict(table.columns)
    if rate_hz is None and (rate_line := _RATE.search("\n".join(table.header))):
        rate_hz = number(rate_line[1])
    period_s = 1.0 / rate_hz if rate_hz and rate_hz > 0.0 else np.nan
    for key in STAMPS:
        if key in columns and columns[key].size > 1 and not (columns[key] != columns[key][0]).any():
            notes.append(f"{key}: the same in every line, left out")
            del columns[key]
    if "time" in columns and table.scales["time"] is None:
        columns |= _unnamed_time(columns.pop("time"), np.isfinite(period_s), notes)
    dot = any("devicetag" in line.lower() for line in table.header)
    if "ticks" in columns and "time" not in columns:
        if not dot and _unit_of(columns["ticks"], _TICKS) == "DOT":
            dot = True
            notes.append("taken for a DOT's export by its clock: ticks of 1 us, gyroscope in deg/s")
        columns["time"] = columns["ticks"] * _TICKS["DOT" if dot else "MT Manager"]
    if "time" not in columns and "utc_s" in columns:
        hour, minute, nano = (columns.get(f"utc_{part}", 0.0) for part in ("hour", "minute", "nano"))
        seconds = 3600.0 * hour + 60.0 * minute + columns["utc_s"] + 1e-9 * nano
        columns["time"] = unwrap_column(seconds)
    if np.isnan(period_s) and not columns.keys() & {"time", "counter"}:
        unknown = ", ".join(name[:40] for name in table.names if column_of(name) is None)
        raise InvalidInputError(
            f"expected a column of time with its unit, as time_s, got {unknown or 'none'}: name it so, or "
            "give --rate-hz"
        )
    clocks = [np.abs(columns[key]) < _LARGEST for key in ("time", "counter") if key in columns]
    timely = np.all(clocks, axis=0)
    if not timely.any():
        raise InvalidInputError("expected lines with a time, got none")
    if not timely.all():
        notes.append(f"{(~timely).sum()} lines without a time were left out")
        columns = {key: column[timely] for key, column in columns.items()}
    counter = columns.get("counter")
    counts = None if counter is None else counter.astype(np.int64)
    return columns, Stamps(counts, columns.get("time"), period_s), dot


def _unnamed_time(times: FloatArray, has_rate: bool, notes: list[str]) -> dict[str, FloatArray]:
    """Times without a unit as the column that they are: times in s, or else the samples' numbers."""
    unit, usual = _unit_of(times, TIMES), usual_step(np.diff(times))
    if unit is None and (not has_rate or np.nanmax(times % 1.0) > 0.0):
        raise InvalidInputError(
            f"expected a time with its unit, as time_s or time_ms, got steps of {usual:g}: "
            "if they count samples, give --rate-hz"
        )
    if unit != "s":
        meaning = "for the samples' numbers" if unit is None else f"as in {unit}, by their steps"
        notes.append(f"times without a unit: taken {meaning}")
    return {"counter": times} if unit is None else {"time": times * TIMES[unit]}


def _unit_of(times: FloatArray, units: dict[str, float]) -> str | None:
    """Unit in which the steps of times are a sensor's, or those of one are of an epoch; None if in none."""
    usual = usual_step(np.diff(times), 0.01)  # of a single time a sensor's
    value, low, high = (times[0], *_EPOCH_S) if usual == 1.0 else (usual, SHORTEST_S, 1.0 / _SLOWEST_HZ)
    return next((unit for unit, scale in units.items() if low <= value * scale <= high), None)


def _claim(table: TextTable, dot: bool) -> Claim:
    """World of the orientations as the header says, or as its program has it."""
    for line in table.header:
        if match := _WORLD.match(line):
            return Claim(match[2].upper(), "as the file says", final=match[1] == "# world")
    if "time" in table.columns:
        by = "as plain files are" if table.names else "as the MT9 software's are"
        return Claim("NWU", by, by_default=bool(table.names))
    return Claim("ENU", "as the sensor's are" if dot else "the program's default", by_default=True)


def _unknown_columns(table: TextTable) -> tuple[str, ...]:
    """Note on unknown columns, and on those of a quantity some of whose axes are missing.

    A program's exports hold many other columns: of theirs, only those that look like a sensor's are listed.
    """
    keys = {name: (column_of(name) or ("",))[0] for name in table.names}
    plain = "time" in keys.values()
    odd = [name for name, key in keys.items() if not key and (plain or _SENSOR_LIKE.match(name))]
    for quantity in ("acc", "gyr", "mag", "quat"):
        columns = [name for name, key in keys.items() if key.startswith(f"{quantity}_")]
        odd += columns if len(columns) < len(_AXES[quantity]) else []
    return (describe_unknown(odd),) if odd else ()


# -- writing


def write_csv(path: PathLike, log: ImuLog) -> None:
    """Write samples as a plain comma-separated file, which `read_log` reads back exactly.

    Columns: ``time_s``, ``counter``, ``accelerometer_x_m_s2`` and so on, ``gyroscope_x_rad_s``,
    ``magnetometer_x_au``, ``quaternion_w`` to ``quaternion_z`` (``world_from_sensor``, x magnetic north, z
    up); only those the log has, blank where a sample lacks them. Notes are comments before them.

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
    columns: dict[str, FloatArray | IntArray] = {"time_s": log.time_s}
    if log.counter is not None:
        columns["counter"] = log.counter
    for vectors in VECTORS:
        if (values := getattr(log, vectors)) is not None:
            sensor, _, unit = vectors.partition("_")
            columns |= {f"{sensor}_{axis}_{unit}": values[:, i] for i, axis in enumerate("xyz")}
    comments = [f"source: {log.source}", *(f"note: {note}" for note in log.notes)]
    if log.world_from_sensor is not None:
        quaternions = log.world_from_sensor.as_quat(scalar_first=True)
        quaternions[~log.oriented] = np.nan
        columns |= {f"quaternion_{axis}": quaternions[:, i] for i, axis in enumerate("wxyz")}
        comments.append("world: NWU (x magnetic north, y west, z up)")
    cells = [
        ["" if number != number else repr(number) for number in values.tolist()]
        for values in columns.values()
    ]
    head = (*("# " + " ".join(comment.split()) for comment in comments), ",".join(columns))
    with whole_file(Path(path)) as part:
        text = "\n".join((*head, *map(",".join, zip(*cells, strict=True)), ""))
        part.write_text(text, encoding="utf-8", newline="\n")
