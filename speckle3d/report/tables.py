"""The report's words: its first sentences, and the cells of its tables for the page's template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from speckle3d.report.data import Record, StudyData
from speckle3d.scoring.statistics import FEWEST
from speckle3d.study.figures import colour_of
from speckle3d.study.overall import (
    ERRORS,
    counted,
    means_table,
    number,
    reference_words,
    told_apart,
    with_interval,
    words_of,
)
from speckle3d.study.results import copy_lines

PART_COLUMNS = ("sweep", "part", "mode", "estimate_mm", "interval_mm", "reference", "reference_mm", *ERRORS)


class Cell(NamedTuple):
    """One cell of a table: its text, a swatch's colour before it, a place that it leads to."""

    text: str
    is_word: bool = False
    is_bold: bool = False
    colour: str = ""
    link: str = ""


class Table(NamedTuple):
    """Heads and lines of cells."""

    heads: Sequence[Cell]
    lines: Sequence[Sequence[Cell]]


def parts_table(rows: Sequence[Record], anchors: Mapping[str, str]) -> Table | None:
    """Errors of every sweep, part and mode; sweeps lead to their figures."""
    sigmas = [row.get("sigma_mm") for row in rows]
    shown = [
        {**row, "interval_mm": None if sigma is None else 1.96 * sigma}
        for row, sigma in zip(rows, sigmas, strict=True)
    ]
    columns = [*PART_COLUMNS, *(["remark"] if any(row.get("remark") for row in rows) else [])]
    return records_table(shown, columns, anchors)


def means(intervals: Sequence[Record]) -> Table | None:
    """Mean and interval of every quantity, a column for each mode."""
    heads, *lines = [
        [Cell(text, is_word=i == 0) for i, text in enumerate(line)] for line in means_table(intervals)
    ]
    return Table(heads, lines) if lines else None


def pairs(paired: Sequence[Record]) -> Table | None:
    """Difference of every two modes in every quantity, bold where they are told apart."""
    names = list(dict.fromkeys(f"{row['mode']} − {row['against']}" for row in paired))
    lines = []
    for quantity in dict.fromkeys(row["quantity"] for row in paired):
        cells = {
            f"{row['mode']} − {row['against']}": Cell(
                with_interval(row, "difference", signed=True), is_bold=bool(row["better"])
            )
            for row in paired
            if row["quantity"] == quantity
        }
        lines.append(
            [Cell(words_of(quantity), is_word=True), *(cells.get(each, Cell("-")) for each in names)]
        )
    return Table([Cell("difference", is_word=True), *map(Cell, names)], lines) if lines else None


def records_table(
    records: Sequence[Record], columns: Sequence[str] = (), anchors: Mapping[str, str] | None = None
) -> Table | None:
    """Any list of records, by default a column for each of their names in the order they first appear.

    Parameters
    ----------
    anchors : mapping of str to str, optional
        Places on the page that the names of sweeps lead to.
    """
    if not records:
        return None
    keys = columns or list(dict.fromkeys(key for record in records for key in record))
    heads, lines = [], list[list[Cell]]([[] for _ in records])
    for key in keys:
        values = [record.get(key) for record in records]
        is_word = any(isinstance(value, str) for value in values)
        name = "+- 95 % / mm" if key == "interval_mm" else words_of(key)
        heads.append(Cell(name, is_word))
        for line, value in zip(lines, values, strict=True):
            text = "-" if value is None else str(value)
            if isinstance(value, float):
                text = number(key, value, signed=key in ERRORS)
            colour = colour_of(text) if key == "mode" else ""
            link = (anchors or {}).get(text, "") if key == "sweep" else ""
            line.append(Cell(text, is_word, colour=colour, link=link))
    return Table(heads, lines)


def summary_lines(study: StudyData) -> list[str]:
    """Say in plain sentences how large the errors are, and whether the sweeps tell the modes apart."""
    done, broken = len(study.done), len(study.broken)
    if not done:
        return [f"Nothing could be reconstructed from {counted(broken, 'sweep')}; the reasons are below."]
    lines = []
    for quantity in ("length_error_percent", "tilt_error_deg"):
        rows = [row for row in study.intervals if row["quantity"] == quantity]
        each = ", ".join(
            f"{row['mode']} {with_interval(row, 'mean')} ({counted(row['sweeps'], 'sweep')})" for row in rows
        )
        if rows:
            lines.append(f"Mean magnitude of {words_of(quantity)}, with its 95 % interval: {each}.")
    if not study.scored:
        lines.append("No sweep has a reference: the lengths below are estimates alone.")
    elif not lines:
        lines.append(
            f"Fewer than {FEWEST} sweeps: no means over sweeps; the errors stand below, sweep by sweep."
        )
    lines += [f"{line[0].upper()}{line[1:]}." for line in told_apart(study.paired)]
    references = {row["sweep"]: row["reference"] for row in study.scored}
    if words := reference_words({row["mode"] for row in study.scored}, references):
        lines.append(f"{words[0].upper()}{words[1:]}.")
    if broken:
        lines.append(f"{broken} of {done + broken} sweeps could not be reconstructed; the reasons are below.")
    return lines + [f"{line}." for line in copy_lines(study.copies)]
