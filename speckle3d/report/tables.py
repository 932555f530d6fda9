"""The report's tables: text and style of every cell, which the page's template turns to HTML."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from speckle3d.report.data import Record
from speckle3d.report.lead import counted
from speckle3d.study.figures import colour_of, label_of
from speckle3d.study.overall import QUANTITIES, Quantity

_UNITS = {"_percent": " / %", "_mm": " / mm", "_deg": " / °", "_s": " / s"}
_ERRORS = ("length_error_mm", "length_error_percent", "tilt_error_deg", "yaw_error_deg", "roll_error_deg")
_PART_COLUMNS = ("sweep", "part", "mode", "reference", "frames", "reference_mm", "estimate_mm", *_ERRORS)
_LONG_LETTERS = 40
"""Letters of a cell that may be broken into lines."""


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes
    ----------
    text : str
        A line break starts a new line.
    is_word : bool
        Aligned to the left.
    colour : str
        Of a swatch before the text; empty for none.
    link : str
        Name of the place on the page that it leads to; empty for none.
    """

    text: str
    is_word: bool = False
    is_bold: bool = False
    colour: str = ""
    link: str = ""

    @property
    def is_long(self) -> bool:
        """Whether it may be broken into lines."""
        return len(self.text) > _LONG_LETTERS


@dataclass(frozen=True)
class Table:
    """Heads and lines of cells; each line has a style of its own, or none."""

    heads: Sequence[Cell]
    lines: Sequence[tuple[str, Sequence[Cell]]]


def parts_table(rows: Sequence[Record], anchors: Mapping[str, str]) -> Table | None:
    """Errors of every sweep, part and mode; sweeps lead to their figures."""
    columns = [*_PART_COLUMNS, *(["remark"] if any(row.get("remark") for row in rows) else [])]
    places = [(row.get("sweep"), row.get("part")) for row in rows]
    styles = ["first" if i == 0 or places[i - 1] != here else "" for i, here in enumerate(places)]
    return _of_records(rows, columns, anchors, styles, _ERRORS)


def modes_table(means: Sequence[Record], best: str | None) -> Table | None:
    """Mean magnitudes of the errors by mode; the best in length in bold."""
    return _of_records(means, styles=["best" if row["mode"] == best else "" for row in means])


def records_table(records: Sequence[Record], anchors: Mapping[str, str] | None = None) -> Table | None:
    """Any list of records, a column for each of their names in the order they first appear."""
    return _of_records(records, anchors=anchors or {})


def intervals_table(intervals: Sequence[Record]) -> Table | None:
    """Mean and interval of every quantity, a column for each mode."""
    most = max((row["sweeps"] for row in intervals), default=0)
    modes = list(dict.fromkeys(str(row["mode"]) for row in intervals))
    lines = [
        [_quantity(quantity), *(_with_interval(quantity, found.get((mode,)), most) for mode in modes)]
        for quantity, found in _by_quantity(intervals, "mode")
    ]
    return _of_cells([f"mean of {counted(most, 'sweep')}", *map(label_of, modes)], lines)


def paired_table(paired: Sequence[Record]) -> Table | None:
    """Difference of every two modes in every quantity, bold where they are told apart."""
    pairs = list(dict.fromkeys((str(row["mode"]), str(row["against"])) for row in paired))
    lines = [
        [_quantity(quantity), *(_difference(quantity, found.get(pair)) for pair in pairs)]
        for quantity, found in _by_quantity(paired, "mode", "against")
    ]
    heads = [f"{label_of(one)} − {label_of(other)}" for one, other in pairs]
    return _of_cells(["difference", *heads], lines)


def heading_of(key: str) -> str:
    """Words and unit from a column's name: ``length_error_mm`` is "length error / mm"."""
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return key.removesuffix(ending).replace("_", " ") + unit
    return key.replace("_", " ")


def _of_cells(heads: Sequence[str], lines: Sequence[Sequence[Cell]]) -> Table | None:
    cells = [Cell(head, is_word=i == 0) for i, head in enumerate(heads)]
    return Table(cells, [("", line) for line in lines]) if lines else None


def _of_records(
    records: Sequence[Record],
    columns: Sequence[str] | None = None,
    anchors: Mapping[str, str] | None = None,
    styles: Sequence[str] | None = None,
    signed: Collection[str] = (),
) -> Table | None:
    if not records:
        return None
    keys = columns or list(dict.fromkeys(key for record in records for key in record))
    words = {key for key in keys if any(isinstance(record.get(key), str) for record in records)}
    heads = [Cell(heading_of(key), is_word=key in words) for key in keys]
    lines = [
        [_cell(key, record.get(key), key in words, anchors or {}, key in signed) for key in keys]
        for record in records
    ]
    return Table(heads, list(zip(styles or [""] * len(lines), lines, strict=True)))


def _cell(key: str, value: Any, is_word: bool, anchors: Mapping[str, str], signed: bool) -> Cell:
    if key == "mode" and isinstance(value, str):
        return Cell(label_of(value), is_word, colour=colour_of(value))
    link = anchors.get(value, "") if key == "sweep" else ""
    return Cell(_shown(key, value, signed), is_word, link=link)


def _shown(key: str, value: Any, signed: bool = False) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:{'+' if signed else ''}.{_digits(key)}f}"
    if isinstance(value, list):
        return ", ".join(_shown(key, one, signed) for one in value)
    return str(value)


def _digits(key: str) -> int:
    if key.startswith(("LPE", "LLE")):
        # From one frame to the next: hundredths of a millimetre are already large.
        return 4
    return 1 if key.endswith(("percent", "_s")) else 2 if key.endswith(("_mm", "_deg")) else 3


def _by_quantity(
    records: Sequence[Record], *keys: str
) -> list[tuple[Quantity, Mapping[tuple[str, ...], Record]]]:
    """Quantities that have records, and these by their values of `keys`."""
    found = [
        (each, {tuple(row[key] for key in keys): row for row in records if row["quantity"] == each.key})
        for each in QUANTITIES
    ]
    return [(quantity, rows) for quantity, rows in found if rows]


def _quantity(quantity: Quantity) -> Cell:
    words = quantity.words.replace(" deg", " / °").replace(" mm", " / mm").replace("error %", "error / %")
    return Cell(words, is_word=True)


def _with_interval(quantity: Quantity, row: Record | None, most: int) -> Cell:
    if row is None:
        return Cell("–")
    text = quantity.shown(row["mean"])
    if row["low"] is not None:
        text += f" ({quantity.shown(row['low'])} to {quantity.shown(row['high'])})"
    return Cell(text if row["sweeps"] == most else f"{text}\n{counted(row['sweeps'], 'sweep')} only")


def _difference(quantity: Quantity, row: Record | None) -> Cell:
    if row is None:
        return Cell("–")
    text = quantity.shown(row["difference"], signed=True)
    if row["low"] is not None:
        low, high = (quantity.shown(row[end], signed=True) for end in ("low", "high"))
        text += f"\n({low} to {high})"
    return Cell(text.replace("-", "−"), is_bold=bool(row["better"]))
