"""The report's words: its first sentences, and text and style of every table cell for the page's template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from speckle3d.report.data import Record
from speckle3d.study.figures import colour_of, label_of
from speckle3d.study.overall import (
    FITTED_TO_TRACKER,
    QUANTITIES,
    beats,
    counted,
    fitted_to_reference,
    mean_over_sweeps,
    means_table,
    reference_words,
)

_UNITS = {"_percent": " / %", "_mm": " / mm", "_deg": " / °", "_s": " / s"}
_ERRORS = ("length_error_mm", "length_error_percent", "tilt_error_deg", "yaw_error_deg", "roll_error_deg")
_PART_COLUMNS = ("sweep", "part", "mode", "reference", "frames", "reference_mm", "estimate_mm", *_ERRORS)
_LONG_LETTERS = 24
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
    return records_table(rows, anchors, columns, styles)


def intervals_table(intervals: Sequence[Record]) -> Table | None:
    """Mean and interval of every quantity, a column for each mode."""
    (title, *modes), *lines = means_table("mean of {}", intervals)
    # Magnitudes have no sign: a "-" stands for no value.
    cells = [[_quantity(words), *(Cell(text.replace("-", "–")) for text in texts)] for words, *texts in lines]
    return _of_cells([title, *map(label_of, modes)], cells)


def paired_table(paired: Sequence[Record]) -> Table | None:
    """Difference of every two modes in every quantity, bold where they are told apart."""
    pairs = list(dict.fromkeys((row["mode"], row["against"]) for row in paired))
    lines = []
    for quantity in QUANTITIES:
        found = {(row["mode"], row["against"]): row for row in paired if row["quantity"] == quantity.key}
        cells = [Cell("–")] * len(pairs)
        for i, row in ((pairs.index(pair), row) for pair, row in found.items()):
            text = quantity.with_interval(row, "difference", signed=True).replace(" [", "\n[")
            cells[i] = Cell(text.replace("-", "−"), is_bold=bool(row["better"]))
        lines += [[_quantity(quantity.words), *cells]] if found else []
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


def records_table(
    records: Sequence[Record],
    anchors: Mapping[str, str] | None = None,
    columns: Sequence[str] | None = None,
    styles: Sequence[str] | None = None,
) -> Table | None:
    """Any list of records, by default a column for each of their names in the order they first appear.

    Parameters
    ----------
    anchors : mapping of str to str, optional
        Places on the page that the names of sweeps lead to.
    styles : sequence of str, optional
        Of each line.
    """
    if not records:
        return None
    keys = columns or list(dict.fromkeys(key for record in records for key in record))
    words = {key for key in keys if any(isinstance(record.get(key), str) for record in records)}
    heads = [Cell(heading_of(key), is_word=key in words) for key in keys]
    lines = [[_cell(key, row.get(key), key in words, anchors or {}) for key in keys] for row in records]
    return Table(heads, list(zip(styles or [""] * len(lines), lines, strict=True)))


def _cell(key: str, value: Any, is_word: bool, anchors: Mapping[str, str]) -> Cell:
    if key == "mode" and isinstance(value, str):
        return Cell(label_of(value), is_word, colour=colour_of(value))
    link = anchors.get(value, "") if key == "sweep" else ""
    if isinstance(value, float):
        # Errors are estimate minus reference, and have a sign.
        value = f"{value:{'+' if key in _ERRORS else ''}.{_digits(key)}f}"
    return Cell("–" if value is None else str(value), is_word, link=link)


def _digits(key: str) -> int:
    if key.startswith(("LPE", "LLE")):
        # From one frame to the next: hundredths of a millimetre are already large.
        return 4
    return 1 if key.endswith(("percent", "_s")) else 2 if key.endswith(("_mm", "_deg")) else 3


def _quantity(words: str) -> Cell:
    words = words.replace(" deg", " / °").replace(" mm", " / mm").replace("error %", "error / %")
    return Cell(words, is_word=True)


@dataclass(frozen=True)
class Scored:
    """Mean errors by mode, from which the first sentences are made.

    Attributes
    ----------
    means : list of dict
        By mode: ``mode``, ``sweeps``, and the means over sweeps of each error's magnitude under short names.
    parts : int
        Of those sweeps.
    together : bool
        Whether the means of all modes are of the same sweeps, those that have every mode.
    left_out : int
        Sweeps with a reference that lack a mode.
    """

    means: list[dict[str, Any]]
    parts: int = 0
    together: bool = True
    left_out: int = 0


def scored_means(rows: Sequence[Record], modes: Sequence[str]) -> Scored:
    """Means by mode over the sweeps that have all modes; where none has, over each mode's own.

    Parameters
    ----------
    rows : sequence of mapping
        Errors by sweep, part and mode, copies left out.
    """
    scored = [row for row in rows if row.get("length_error_mm") is not None]
    modes = [mode for mode in modes if any(row["mode"] == mode for row in scored)]
    held_by = {s: {row["mode"] for row in scored if row["sweep"] == s} for s in {r["sweep"] for r in scored}}
    whole = {sweep for sweep, held in held_by.items() if held.issuperset(modes)}
    used = [row for row in scored if row["sweep"] in whole] or scored
    means = []
    for mode in modes:
        mine = [row for row in used if row["mode"] == mode]
        values = {key.replace("_error", ""): mean_over_sweeps(mine, key) for key in _ERRORS}
        known = {short: value if np.isfinite(value) else None for short, value in values.items()}
        means.append({"mode": mode, "sweeps": len({row["sweep"] for row in mine}), **known})
    parts = len({(row["sweep"], row["part"]) for row in used})
    return Scored(means, parts, bool(whole) or not scored, len(held_by) - len(whole))


def summary_lines(
    scored: Scored,
    done: int,
    broken: int,
    paired: Sequence[Record] = (),
    references: Mapping[str, str] | None = None,
) -> list[str]:
    """Say in plain sentences which mode is right, by how much, and whether the sweeps can tell.

    Parameters
    ----------
    scored : Scored
        Mean magnitude of each error by mode.
    done, broken : int
        Number of sweeps with and without results.
    paired : sequence of mapping
        Modes compared in pairs, as in ``study.json``.
    references : mapping of str to str, optional
        What each sweep was compared with.
    """
    if not done:
        return [f"Nothing could be reconstructed from {counted(broken, 'sweep')}; the reasons are below."]
    lines = []
    means = scored.means
    best, straightest = best_of(means, "length_percent"), best_of(means, "tilt_deg")
    if best is None:
        lines.append(
            "No sweep has a reference, so no mode can be called right: the lengths below are estimates alone."
        )
    elif not scored.together:
        lines.append(
            "No sweep was reconstructed in every mode, so the modes cannot be ranked together: their means "
            "are of different sweeps. They are compared in pairs below, on the sweeps that have both."
        )
    else:
        lines.append(_length_line(scored, best) + _doubt(means, paired, "length_error_percent", best))
        if straightest is not None:
            known = [row for row in means if row["tilt_deg"] is not None]
            tilts = ", ".join(f"{_named(row['mode'])} {row['tilt_deg']:.2f}°" for row in known)
            tilt_line = f"In tilt {_named(straightest)} is closest. Mean tilt error: {tilts}."
            lines.append(tilt_line + _doubt(means, paired, "tilt_error_deg", straightest))
    if words := reference_words(references or {}):
        lines.append(f"{words[0].upper()}{words[1:]}.")
    if fitted_to_reference({row["mode"] for row in means}, references or {}):
        fitted = [_named(row["mode"]) for row in means if row["mode"] in FITTED_TO_TRACKER]
        named, (were, are) = " and ".join(fitted), (("was", "it is"), ("were", "they are"))[len(fitted) > 1]
        lines.append(
            f"{named[0].upper()}{named[1:]} {were} fitted to the tracker that {are} compared with: the "
            "errors say how well it fits, not how right it is."
        )
    if broken:
        lines.append(f"{broken} of {done + broken} sweeps could not be reconstructed; the reasons are below.")
    return lines


def best_of(means: Sequence[Record], key: str) -> str | None:
    """Mode with the smallest mean; None without any."""
    valued = [row for row in means if row[key] is not None]
    return str(min(valued, key=lambda row: row[key])["mode"]) if valued else None


def clearly_best(means: Sequence[Record], paired: Sequence[Record]) -> str | None:
    """Mode whose length is best and told apart from every other mode's; None if no mode is."""
    best = best_of(means, "length_percent")
    others = [str(row["mode"]) for row in means if row["mode"] != best]
    if best is None or not others:
        return None
    return best if all(beats(paired, "length_error_percent", best, other) for other in others) else None


def _named(mode: str) -> str:
    """A mode within a sentence."""
    return f"“{label_of(mode)}”"


def _length_line(scored: Scored, best: str) -> str:
    means = scored.means
    mine = next(row for row in means if row["mode"] == best)
    others = [
        f"{row['length_percent']:.1f} % for {_named(row['mode'])}"
        for row in means
        if row["mode"] != best and row["length_percent"] is not None
    ]
    against = f", against {', '.join(others)}" if others else ""
    which = f" that {'has' if mine['sweeps'] == 1 else 'have'} every mode" if scored.left_out else ""
    return (
        f"Over {counted(mine['sweeps'], 'sweep')}{which} ({counted(scored.parts, 'part')}), {_named(best)} "
        f"has the smallest error of length: {mine['length_percent']:.1f} % on average over sweeps "
        f"({mine['length_mm']:.2f} mm){against}."
    )


def _doubt(means: Sequence[Record], paired: Sequence[Record], quantity: str, best: str) -> str:
    """Say which modes these sweeps do not tell apart from the best."""
    others = [str(row["mode"]) for row in means if row["mode"] != best]
    alike = [mode for mode in others if not beats(paired, quantity, best, mode)]
    if not others:
        return ""
    if not alike:
        apart = "it apart from every other mode" if len(others) > 1 else "them apart"
        return f" The sweeps tell {apart}."
    if len(alike) == len(others):
        others_named = "the other modes" if len(others) > 1 else _named(others[0])
        return f" It is not told apart from {others_named} by these sweeps: the difference may be chance."
    return f" It is not told apart from {' and '.join(map(_named, alike))}: that difference may be chance."
