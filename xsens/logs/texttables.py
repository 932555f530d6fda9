"""Read tables of numbers in text: names of columns, perhaps with units, to columns in SI units.

Cells without a number are NaN, lines of another length are left out.
"""

import csv
import math
import re
from array import array
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from itertools import chain, islice, zip_longest

import numpy as np
from scipy.constants import degree, g

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import COUNTS, LATE, TICKS, unwrap, usual_step

_SEPARATORS = ("\t", ";", "|", ",", None)
"""In order of trust: a tab only separates, a comma may be a decimal point, blanks (None) may be padding."""

_LONGEST_HEADER = 10_000
"""Lines among which the first numbers must be: to look at as many takes a second or two."""

_DATE_DIGIT, _MILLISECONDS = re.compile(r"\b(\d)\b"), re.compile(r":(\d{3})$")
"""In dates and times: a number without its leading zero, and thousandths after a colon."""

_DIGIT = re.compile("[0-9]")
# -- names of columns

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_FORCES = dict.fromkeys(("m_s2", "m_s_2", "m_s_s", "mps2"), 1.0) | {"g": g, "mg": 1e-3 * g}
_RATES = {"rad_s": 1.0, "rads": 1.0, "mrad_s": 1e-3, "mdps": 1e-3 * degree}
_RATES |= dict.fromkeys(("deg_s", "dps", "°_s"), degree)
_FIELDS = dict.fromkeys(
    ("au", "a_u", "ut", "µt", "nt", "mt", "t", "gauss", "g", "mgauss", "mg", "local_flux"), 1.0
)
_ANGLES = {"deg": 1.0, "°": 1.0, "rad": 1.0 / degree}
_AXES = {
    "0": "w",
    "1": "x",
    "2": "y",
    "3": "z",
    "scalar": "w",
    "roll": "x",
    "pitch": "y",
    "yaw": "z",
    "ns": "nano",
}
"""Axes by their other names."""

_COLUMNS: tuple[tuple[str, str, str, Mapping[str, float]], ...] = (
    ("acc", "acc(?:el(?:eration|erometers?)?)?|a", "[xyz]", _FORCES),
    ("acc", "accelerometer_?acceleration", "[xyz]", {"g": -g}),  # as iOS has it: gravity, not the force
    ("free", "(?:free|lin(?:ear)?|user)_?(?:acc(?:el(?:eration)?)?)?", "[xyzenu]", _FORCES),
    ("dv", "dv|delta_?v|vel(?:ocity)?_?inc(?:rement)?", "[xyz1-3]", {}),
    ("gyr", "gyro?(?:scopes?)?(?:_?rotation)?|angular_(?:velocity|rate)|as|[gw]", "[xyz]", _RATES),
    ("dq", "(?:dq|delta_?q|ori(?:entation)?_?inc(?:rement)?)(?:_?q)?", "[wxyz0-3]", {}),
    ("mag", "mag(?:n|neto|netometers?|netic)?(?:_field)?|[mh]", "[xyz]", _FIELDS),
    ("quat", "quat(?:ernion)?(?:_?q)?|q|orientation", "[wxyz0-3]|scalar", {}),
    ("euler", "(?:euler)?", "roll|pitch|yaw|(?<=euler_)[xyz]", _ANGLES),
    ("euler", "angle", "[xyz]", _ANGLES),
    ("mat", "mat", "[1-3]_[1-3]", {}),
    ("optical", "vicon_orientation", "[wxyz]", {}),
    (
        "time",
        "(?:[a-z]+_?)?(?:and_)?time(?:_?stamp)?(?:_?startup|_since_?[a-z0-9]+)?|ts?|epoch|(?:s_)?elapsed",
        "",
        TIMES,
    ),
    (
        "counter",
        "(?:packet|sample)?_?(?:counter|number|index)|(?:frame|sample)_?(?:number|no)?|seq",
        "",
        {},
    ),
    ("ticks", "sampletimefine", "", {}),
    ("utc", "utc|(?:header_)?stamp", "year|month|day|hour|minute|s|nano|ns", {}),
)
"""Quantity; its names with other characters than letters and digits as underscores, and those of its axes;
factors from its units to SI, angles to degrees, while fields stay in theirs."""

_PREFIX = "(?:(?:imu|field|sensor|data|shimmer(?:_[0-9a-f]{4})?)_|uncomp)*"
_SUFFIX = "(?:_rs_s|_ln|_wr|_unix|_startup)?"
_PATTERNS = [
    (quantity, re.compile(rf"{_PREFIX}(?:{names}){_SUFFIX}_?({axes})(?:_cal)?(?:_(.+))?$"), units)
    for quantity, names, axes, units in _COLUMNS
]

_SPELLINGS = {
    "s": "(?:per_)?sec(?:ond)?s?|s_1",
    "ms": "m(?:illi)?sec(?:ond)?s?|millis",
    "us": "(?:u|micro)sec(?:ond)?s?|micros",
    "ns": "n(?:ano)?sec(?:ond)?s?|nanos",
    "deg": "degrees?",
    "rad": "radians?",
}
"""Units, and how they may be spelt out."""

STAMPS = ("time", "counter", "ticks")

_VECTOR_AXES = [f"{quantity}_{axis}" for quantity in ("acc", "gyr", "mag") for axis in "xyz"]
_MT9_EXPORTS = {
    4: ["time_s", "roll_deg", "pitch_deg", "yaw_deg"],
    10: ["time_s", *_VECTOR_AXES],  # or a matrix
    11: ["time_s", *_VECTOR_AXES, "temperature"],
}
"""Columns of the MT9 software's exports, which name none, by their number."""

_SPANS = (60, 1 << 8, 1 << 10, 3600, 1 << 12, COUNTS, 86400, TICKS)
"""At which counters and clocks wrap round: words of so many bits, minutes, hours and days."""

_WHOSE = re.compile(
    r"(?:sensor|device|imu|node|unit|segment|body|placement)[ _]?(?:id|name|no|nr|number|tag|serial)?$"
    r"|(?:id|tag|mac(?:[ _]?address)?|serial(?:[ _]?number)?)$"
)
"""Names of columns that say which sensor a row is of."""


@cache
def column_of(name: str) -> tuple[str, float | None] | None:
    """Key of a column by its name in lower case; None if it is not understood.

    With it comes what turns its numbers to SI units, None if the name states no unit.
    """
    words = stated = re.sub(r"[^a-z0-9°µ]+", "_", name.replace("²", "2")).strip("_")
    for short, spelling in _SPELLINGS.items():
        words = re.sub(rf"(?<![^_])(?:{spelling})(?![^_])", short, words)
    if words in TIMES:  # as millis; s alone may be anything
        return ("time", TIMES[words]) if words != stated else None
    for quantity, pattern, units in _PATTERNS:
        if match := pattern.match(words):
            axis, unit = match.groups()
            scale = units.get(unit)
            if unit and scale is None:
                return None
            return f"{quantity}_{_AXES.get(axis, axis)}".strip("_"), scale
    return None


def describe_unknown(names: Sequence[str]) -> str:
    """Sentence on names of columns, with some of those that are understood."""
    rest_count = f" and {len(names) - 9} more" if len(names) > 9 else ""
    examples = ", ".join(name[:40] for name in names[:9])
    return f"columns not understood: {examples}{rest_count} (expected time_s, acc_x, gyr_x_rad_s, mag_x)"


# -- tables


@dataclass(frozen=True)
class TextTable:
    """A table of numbers: the lines before it, names in lower case, and the columns that are understood.

    `columns` are in SI units by key, without blank ones; `scales` what their names' units make of them, None
    of a name without unit. An MT9 export has no `names`. `notes` count lines of another length than the first
    or without a digit.
    """

    header: list[str]
    names: tuple[str, ...]
    columns: dict[str, FloatArray]
    scales: dict[str, float | None]
    notes: tuple[str, ...]


def read_table(lines: Iterable[str]) -> TextTable:
    """Find the table in some lines and read it.

    It begins where lines of names, of which three are known, stand above as many cells with a number among
    them, or where four cells at least are all numbers.

    Raises
    ------
    InvalidInputError
        If there is no table, a quantity has two columns, or its rows are of several sensors.
    """
    rows, header = (line for line in lines if line.strip("\r\n")), ["", ""]
    for line in islice(rows, _LONGEST_HEADER):
        for separator in () if line.startswith("#") else _SEPARATORS:
            cells = _cells(line, separator)
            numbers = [cell == "nan" or not math.isnan(number(cell)) for cell in cells]
            if not any(numbers):
                continue
            above, below = (_cells(text.lstrip("#% "), separator) for text in header[-2:])
            blanks = [part for name in below for part in name.split()]
            for names in (_join(above, below), _join([], below), blanks):  # blanks where tabs should be
                fits = len(names) <= len(cells) and not any(cells[len(names) :])
                if fits and sum(column_of(name) is not None for name in names) >= 3:
                    return _read_rows(chain([line], rows), header, names, separator)
            if len(cells) >= 4 and all(numbers):
                names = below if any(below) and len(below) == len(cells) else []
                return _read_rows(chain([line], rows), header, names, separator, len(cells))
        header.append(line.rstrip("\n"))
    raise InvalidInputError(
        "expected messages of a sensor, or names of columns above lines of as many cells with numbers, got "
        "neither"
    )


def number(cell: str) -> float:
    """The number in a cell, or the seconds of a date and time or a time of day; NaN if it is none.

    A decimal point may be a comma.
    """
    cell = cell.strip().strip('"')
    with suppress(ValueError):
        return float(cell.replace(",", "."))
    cell = _MILLISECONDS.sub(r".\1", _DATE_DIGIT.sub(r"0\1", cell.replace("/", "-")))
    for text in (cell, f"1970-01-01T{cell}"):
        with suppress(ValueError):
            moment = datetime.fromisoformat(text)
            return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    return math.nan


def _split(line: str, separator: str | None) -> list[str]:
    line = line.rstrip("\r\n")
    if '"' in line and separator:
        return next(csv.reader([line], delimiter=separator))
    return line.split(separator)


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip('"').lower() for cell in _split(line, separator)]


def _join(above: list[str], below: list[str]) -> list[str]:
    """Names in two lines: the lower one holds their units or axes, the upper one perhaps groups."""
    names, group = list[str](), ""
    for over, under in zip_longest(above, below, fillvalue=""):
        group = over or group
        spellings = (f"{group} {under}".strip(), under) if under else ()
        names.append(next(filter(column_of, spellings), over or under))
    while names and not names[-1]:  # what separators at the end of a line make
        names.pop()
    return names


def _read_rows(
    lines: Iterable[str], header: list[str], names: list[str], separator: str | None, width: int = 0
) -> TextTable:
    """Read the columns that are understood; without names, those of an MT9 export of that width."""
    titles = names or _MT9_EXPORTS.get(width)
    if titles is None:
        raise InvalidInputError(
            f"expected columns with names, or the 4, 10 or 11 of an MT9 export without, got {width} without"
        )
    places, scales = dict[str, int](), dict[str, float | None]()
    for i, title in enumerate(titles):
        if (kind := column_of(title)) is None:
            continue
        key, scale = kind
        if key in places and key not in ("counter", "time"):
            raise InvalidInputError(
                f"expected the columns of one sensor, got two of {key}: {titles[places[key]]}, {title}"
            )
        # Of several times, the first with its unit, else the first.
        if key not in places or (scales[key] is None and scale is not None):
            places[key], scales[key] = i, scale
    if not places:
        raise InvalidInputError(describe_unknown(titles))
    owners, whose = dict[int, str](), [i for i, title in enumerate(titles) if _WHOSE.match(title)]
    values, left_out = array("d"), 0
    for line in lines:
        cells = _split(line if separator == "," else line.replace(",", "."), separator)
        while len(cells) > len(titles) and not cells[-1].strip():
            cells.pop()
        if len(cells) != len(titles) or not _DIGIT.search(line):
            left_out += 1
            continue
        for i in whose:
            if (owner := cells[i].strip()) != owners.setdefault(i, owner):
                raise InvalidInputError(
                    f"column {titles[i]}: expected rows of one sensor, got {owners[i]}, {owner}: "
                    "split the table"
                )
        try:
            values.extend([float(cells[i]) for i in places.values()])
        except ValueError:  # quoted, blank, a time, or a word
            values.extend([number(cells[i]) for i in places.values()])
    rows, columns = np.frombuffer(values).reshape(-1, len(places)), {}
    if left_out > len(rows):
        raise InvalidInputError(
            f"expected lines of {len(titles)} cells, got {len(rows)} of {left_out + len(rows)}"
        )
    notes = (f"{left_out} lines of another length or without a digit were left out",) if left_out else ()
    for key, column in zip(places, rows.T, strict=True):
        if np.isfinite(column).any():
            with np.errstate(over="ignore"):  # damage, which is left out as no measurement
                columns[key] = (unwrap_column(column) if key in STAMPS else column) * (scales[key] or 1.0)
    return TextTable(header, tuple(filter(None, names)), columns, scales, notes)


def unwrap_column(column: FloatArray) -> FloatArray:
    """A counter or clock unwrapped where it wraps round as `_SPANS` have it; any other as it is."""
    finite = np.isfinite(column)
    steps = np.diff(column[finite])
    for span in _SPANS:
        falls = steps < -0.5 * span
        if falls.any() and column[finite].max() < span:
            rising = column.copy()
            rising[finite] = unwrap(column[finite], span)
            if np.diff(rising[finite])[falls].max() <= LATE * usual_step(steps):
                return rising
    return column
