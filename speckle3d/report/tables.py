"""Sentences and table cells of the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from speckle3d.core.text import printable
from speckle3d.scoring.statistics import FEWEST
from speckle3d.study.figures import colour_of
from speckle3d.study.overall import (
    ERRORS,
    Row,
    better_modes,
    number,
    reference_words,
    with_interval,
    words_of,
)
from speckle3d.study.results import Study

Table = Sequence[Sequence[str]]
"""Cells, the first line the heads; markup of our own is `Markup`."""


def sweeps_text(count: int) -> str:
    """Number of sweeps, in words."""
    return f"{count} sweep{'s' * (count != 1)}"


def parts_table(rows: Sequence[Row], anchors: Mapping[str, str]) -> Table:
    """Errors of every sweep, part and mode; sweeps lead to their figures."""
    table = []
    for row in rows:
        sigma = row.get("sigma_mm")
        table.append({**row, "interval_mm": None if sigma is None else 1.96 * sigma})
    columns = ["sweep", "part", "mode", "estimate_mm", "interval_mm", "reference", "reference_mm", *ERRORS]
    remark = ["remark"] if any(row.get("remark") for row in rows) else []
    return records_table(table, columns + remark, anchors)


def pairs(comparisons: Sequence[Row]) -> Table:
    """Difference of every two modes in every quantity, bold where they are told apart."""
    columns = list(dict.fromkeys(f"{row['mode']} − {row['against']}" for row in comparisons))
    lines: dict[str, dict[str, str]] = {}
    for row in comparisons:
        text = with_interval(row, "difference", signed=True)
        cell = Markup("<b>{}</b>").format(text) if row["better"] else text
        lines.setdefault(row["quantity"], {})[f"{row['mode']} − {row['against']}"] = cell
    body = [
        [words_of(name), *(cells.get(column, "-") for column in columns)] for name, cells in lines.items()
    ]
    return [["difference", *columns], *body] if body else []


def records_table(
    records: Sequence[Row], columns: Sequence[str] = (), anchors: Mapping[str, str] | None = None
) -> Table:
    """Any list of records, by default a column for each of their names that has a value somewhere.

    Parameters
    ----------
    anchors : mapping of str to str, optional
        Places on the page that the names of sweeps lead to.
    """
    values = (item for record in records for item in record.items())
    keys = columns or list(dict.fromkeys(key for key, value in values if value is not None))
    heads = ["+- 95 % / mm" if key == "interval_mm" else words_of(key) for key in keys]
    lines = [[_cell(key, record.get(key), anchors or {}) for key in keys] for record in records]
    return [heads, *lines] if lines else []


def _cell(key: str, value: object, anchors: Mapping[str, str]) -> str:
    if isinstance(value, float):
        return number(key, value, signed=key in ERRORS)
    text = "-" if value is None else printable(str(value), kept="\n\t")
    if key == "mode":
        swatch = '<span class="swatch" style="background:{}"></span>{}'
        return Markup(swatch).format(colour_of(text), text)
    if key == "sweep" and value in anchors:
        return Markup('<a href="#{}">{}</a>').format(anchors[str(value)], text)
    return text


def rows_with_error(study: Study) -> list[Row]:
    """Rows with an error of length."""
    return [row for row in study.rows if np.isfinite(row["length_error_percent"])]


def summary_lines(study: Study) -> list[str]:
    """Say in plain sentences how large the errors are, and whether the sweeps tell the modes apart."""
    successes, failures, rows = len(study.successes), len(study.failures), rows_with_error(study)
    if not successes:
        count = sweeps_text(failures)
        return [f"Nothing could be reconstructed from {count}; the reasons are below."]
    lines, (intervals, comparisons) = [], study.statistics
    for quantity in ("length_error_percent", "tilt_error_deg"):
        of = [row for row in intervals if row["quantity"] == quantity]
        names = ", ".join(
            f"{row['mode']} {with_interval(row, 'mean')} ({sweeps_text(row['sweeps'])})" for row in of
        )
        if of:
            lines.append(f"mean magnitude of {words_of(quantity)}, with its 95 % interval: {names}")
    if not rows:
        lines.append("no sweep has a reference: the lengths below are estimates alone")
    elif not lines:
        lines.append(f"fewer than {FEWEST} sweeps: no means over sweeps; errors stand below, sweep by sweep")
    lines += better_modes(comparisons)
    references = {row["sweep"]: row["reference"] for row in rows}
    lines.append(reference_words({row["mode"] for row in rows}, references))
    if failures:
        lines.append(f"{failures} of {successes + failures} sweeps have no result; the reasons are below")
    return [f"{line[0].upper()}{line[1:]}." for line in lines if line]
