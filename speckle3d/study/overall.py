"""Results over all sweeps of a study: mean errors by mode with intervals, and which modes are told apart.

A sweep is the unit. Of the errors of its parts the mean magnitude counts; drift and displacement are one
number per sweep anyhow. A mode's mean is over the sweeps that have it; modes are ranked by their means over
the sweeps that have all of them. Two modes are told apart where the interval of their differences, sweep by
sweep, leaves out zero, and a signed-rank test says so too (p <= `LEVEL`) after Holm's correction for all
pairs of modes.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.tables import text_table
from speckle3d.scoring.statistics import holm, mean_interval, paired_comparison

LEVEL = 0.05

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Quantity:
    """A number that modes are compared by: its key in a study's rows, words for it, and its format."""

    key: str
    words: str
    form: str = "{:.2f}"
    signed_parts: bool = False
    """Whether it is a signed error of every part of a sweep, not one number per sweep."""

    def shown(self, value: float, signed: bool = False) -> str:
        """Write a value; a dash for none."""
        if not np.isfinite(value):
            return "-"
        return (self.form.replace(":", ":+") if signed else self.form).format(value)

    def with_interval(self, row: Row, name: str, signed: bool = False) -> str:
        """Write the value of that name in a record, and its interval if it has one."""
        text = self.shown(row[name], signed)
        if row.get("low") is not None:
            text += f" [{self.shown(row['low'], signed)}, {self.shown(row['high'], signed)}]"
        return text


QUANTITIES = (
    Quantity("length_error_percent", "length error %", "{:.1f}", True),
    Quantity("length_error_mm", "length error mm", signed_parts=True),
    Quantity("tilt_error_deg", "tilt error deg", signed_parts=True),
    Quantity("yaw_error_deg", "yaw error deg", signed_parts=True),
    Quantity("roll_error_deg", "roll error deg", signed_parts=True),
    Quantity("FDR_percent", "FDR %", "{:.1f}"),
    Quantity("ADR_percent", "ADR %", "{:.1f}"),
    Quantity("MD_mm", "MD mm"),
    Quantity("SD_mm", "SD mm", "{:.1f}"),
    Quantity("HD_mm", "HD mm"),
    Quantity("EA_deg", "EA deg"),
    Quantity("GPE_mm", "GPE mm", "{:.3f}"),
    Quantity("GLE_mm", "GLE mm", "{:.3f}"),
    Quantity("LPE_mm", "LPE mm", "{:.4f}"),
    Quantity("LLE_mm", "LLE mm", "{:.4f}"),
)


def over_sweeps(
    rows: Sequence[Row], drift: Sequence[Row]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Intervals of every quantity and mode, and every two modes compared in every quantity.

    Parameters
    ----------
    rows : sequence of mapping
        Errors by sweep, part and mode, as in ``study.json``.
    drift : sequence of mapping
        Drift by sweep and mode.

    Returns
    -------
    intervals : list of dict
        ``quantity``, ``mode``, ``sweeps``, ``mean`` over sweeps, and ``low`` and ``high`` of its 95 %
        bootstrap interval, None where there are too few sweeps.
    paired : list of dict
        ``quantity``, ``mode``, ``against``, ``sweeps`` that have both, ``difference`` (mean of mode less
        against), ``low``, ``high``, ``wilcoxon_p``, ``holm_p``, and ``better``: the mode with less error,
        None where they are not told apart.
    """
    intervals: list[dict[str, Any]] = []
    paired: list[dict[str, Any]] = []
    for quantity in QUANTITIES:
        values = _by_mode(quantity, rows, drift)
        for mode, each in values.items():
            intervals.append({"quantity": quantity.key, "mode": mode, **asdict(mean_interval(each))})
        paired += _pairs(quantity, values)
    return intervals, paired


def beats(paired: Sequence[Row], quantity: str, mode: str, other: str) -> bool:
    """Whether the sweeps show that a mode has less error than another in a quantity."""
    return any(
        row["quantity"] == quantity
        and {row["mode"], row["against"]} == {mode, other}
        and row["better"] == mode
        for row in paired
    )


def shared_means(rows: Sequence[Row], drift: Sequence[Row] = ()) -> list[dict[str, Any]]:
    """Means over the sweeps that have every mode, by which modes are ranked; none where no sweep has.

    Parameters
    ----------
    rows, drift : sequence of mapping
        As `over_sweeps` takes them.

    Returns
    -------
    list of dict
        ``quantity``, ``mode``, ``sweeps``, ``mean``.
    """
    found = []
    for quantity in QUANTITIES:
        values = _by_mode(quantity, rows, drift)
        together = np.isfinite(np.array([*values.values()])).all(axis=0) if values else np.zeros(0, bool)
        if together.any():
            means = {mode: float(each[together].mean()) for mode, each in values.items()}
            named = {"quantity": quantity.key, "sweeps": int(together.sum())}
            found += [named | {"mode": mode, "mean": mean} for mode, mean in means.items()]
    return found


def are_uneven(intervals: Sequence[Row]) -> bool:
    """Whether in some quantity the modes' means are of different sweeps."""
    counts = {(row["quantity"], row["sweeps"]) for row in intervals}
    return len(counts) > len({quantity for quantity, _ in counts})


def overall_text(
    intervals: Sequence[Row],
    paired: Sequence[Row],
    shared: Sequence[Row] = (),
    references: Mapping[str, str] | None = None,
) -> str:
    """Table of means and intervals, then the modes that are told apart; empty without any sweep.

    Parameters
    ----------
    shared : sequence of mapping
        From `shared_means`, shown where the modes are not of the same sweeps.
    references : mapping of str to str, optional
        What each sweep was compared with.
    """
    if not intervals:
        return ""
    lines = text_table(means_table("mean of {}", intervals)).splitlines()
    if len({row["sweeps"] for row in intervals}) > 1:
        lines.append("(n): of n sweeps only")
    lines += _told(intervals, paired)
    words = reference_words(references or {})
    lines += textwrap.wrap(words, 100, subsequent_indent="  ") if words else []
    if fitted_to_reference({row["mode"] for row in intervals}, references or {}):
        lines.append("pose was fitted to this tracker: its errors say how well it fits, not how right it is")
    if are_uneven(intervals):
        lines.append("these means are not all of the same sweeps: side by side they do not compare modes")
        if shared:
            lines += ["", *text_table(means_table("{} with every mode", shared)).splitlines()]
        else:
            lines.append("no sweep has every mode: modes compare in pairs alone")
    return "\n".join(lines) + "\n"


def means_table(title: str, records: Sequence[Row]) -> list[list[str]]:
    """Cells of means and intervals: heads, then a line for each quantity with a column for each mode.

    Parameters
    ----------
    title : str
        Of the first column; ``{}`` stands for the number of sweeps.
    records : sequence of mapping
        From `over_sweeps` or `shared_means`. A mean of fewer sweeps than others has their number behind it.
    """
    most = max((row["sweeps"] for row in records), default=0)
    modes = list(dict.fromkeys(row["mode"] for row in records))
    lines = [[title.format(counted(most, "sweep")), *modes]]
    for quantity in QUANTITIES:
        cells = {
            row["mode"]: quantity.with_interval(row, "mean") + f" ({row['sweeps']})" * (row["sweeps"] != most)
            for row in records
            if row["quantity"] == quantity.key
        }
        if cells:
            lines.append([quantity.words, *(cells.get(mode, "-") for mode in modes)])
    return lines


def counted(count: int, what: str) -> str:
    """Number and noun."""
    return f"{count} {what}{'s' * (count != 1)}"


def reference_words(references: Mapping[str, str]) -> str:
    """What the sweeps were compared with, and which with what where they differ; empty without any."""
    by_name: dict[str, list[str]] = {}
    for sweep, name in references.items():
        if name != "none":
            by_name.setdefault(name, []).append(sweep)
    if len(by_name) < 2:
        return f"reference: {next(iter(by_name))}" if by_name else ""
    which = "; ".join(f"{name} of {', '.join(sweeps)}" for name, sweeps in by_name.items())
    return f"references differ: {which}; the means mix errors against both"


FITTED_TO_TRACKER = frozenset({"pose", "fused"})
"""Modes that use the tracker where there is one."""


def fitted_to_reference(modes: Collection[str], references: Mapping[str, str]) -> bool:
    """Whether a mode was fitted to the very tracker that it is compared with."""
    return bool(FITTED_TO_TRACKER.intersection(modes)) and "tracker" in references.values()


def _by_mode(quantity: Quantity, rows: Sequence[Row], drift: Sequence[Row]) -> dict[str, FloatArray]:
    """One value per sweep, NaN where a mode has none; modes without any are left out."""
    held = rows if quantity.signed_parts else drift
    sweeps, modes = (list(dict.fromkeys(row[key] for row in held)) for key in ("sweep", "mode"))
    found: dict[str, FloatArray] = {}
    for mode in modes:
        mine = [row for row in held if row["mode"] == mode]
        values = np.array([_of_sweep(quantity, [row for row in mine if row["sweep"] == s]) for s in sweeps])
        if np.isfinite(values).any():
            found[mode] = values
    return found


def mean_over_sweeps(rows: Sequence[Row], key: str) -> float:
    """Mean over sweeps of the mean magnitude of an error in their parts, of one mode's rows."""
    quantity = next(each for each in QUANTITIES if each.key == key)
    values = list(_by_mode(quantity, rows, rows).values())
    return float(np.nanmean(values[0])) if values else float("nan")


def _of_sweep(quantity: Quantity, rows: Sequence[Row]) -> float:
    values = np.array([row.get(quantity.key) for row in rows], dtype=float)
    values = np.abs(values[np.isfinite(values)])
    return float(values.mean()) if values.size else float("nan")


def _pairs(quantity: Quantity, values: Mapping[str, FloatArray]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for one, other in combinations(values, 2):
        if not np.isfinite(values[one] - values[other]).any():
            continue
        difference, wilcoxon_p = paired_comparison(values[one], values[other])
        row = {"quantity": quantity.key, "mode": one, "against": other, "sweeps": difference.sweeps}
        row |= {"difference": difference.mean, "low": difference.low, "high": difference.high}
        rows.append(row | {"wilcoxon_p": wilcoxon_p})
    for row, corrected in zip(rows, holm([row["wilcoxon_p"] for row in rows]), strict=True):
        row["holm_p"], row["better"] = corrected, _better(row, corrected)
    return rows


def _better(row: Row, holm_p: float | None) -> str | None:
    low, high = row["low"], row["high"]
    if low is None or high is None or holm_p is None or holm_p > LEVEL or low <= 0 <= high:
        return None
    return str(row["mode"] if high < 0 else row["against"])


def _told(intervals: Sequence[Row], paired: Sequence[Row]) -> list[str]:
    lines = []
    if any(row["low"] is not None for row in intervals):
        lines.append("[..]: 95 % interval over sweeps, by bootstrap")
    found: dict[str, list[str]] = {}
    for quantity in QUANTITIES:
        if words := _better_words([row for row in paired if row["quantity"] == quantity.key]):
            found.setdefault(words, []).append(quantity.words)
    for words, names in found.items():
        lines += textwrap.wrap(f"less {', '.join(names)}: {words}", 100, subsequent_indent="  ")
    if found:
        lines.append(f"(told apart sweep by sweep: signed-rank p <= {LEVEL:g} after Holm's correction)")
    if paired and not found:
        lines.append("no two modes are told apart by these sweeps")
    return lines


def _better_words(rows: Sequence[Row]) -> str:
    """Each mode that is better than others, and those it is better than."""
    worse: dict[str, list[str]] = {}
    for row in rows:
        if row["better"]:
            other = row["against"] if row["better"] == row["mode"] else row["mode"]
            worse.setdefault(row["better"], []).append(other)
    return "; ".join(f"{mode} than {', '.join(others)}" for mode, others in worse.items())
