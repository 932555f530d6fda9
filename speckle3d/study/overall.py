"""Results over all sweeps of a study: mean errors by mode with intervals, and which modes are told apart.

A sweep is the unit, and from `FEWEST` sweeps on there are statistics. Of the errors of a sweep's parts the
mean magnitude counts; drift and displacement are one number per sweep anyhow. Two modes are told apart where
the interval of their differences, sweep by sweep, leaves out zero, and a signed-rank test says so too
(p <= `LEVEL`) after Holm's correction for all pairs of modes.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from speckle3d.core.text import text_table
from speckle3d.scoring.displacements import MEANINGS
from speckle3d.scoring.statistics import FEWEST, holm, mean_interval, signed_rank_p

LEVEL = 0.05

Row = Mapping[str, Any]

ERRORS = ("length_error_percent", "length_error_mm", "tilt_error_deg", "yaw_error_deg", "roll_error_deg")
"""Signed errors of every part of a sweep."""

QUANTITIES = (*ERRORS, *MEANINGS)
"""Keys of what modes are compared by; drift and displacement are one number per sweep."""

FITTED_TO_TRACKER = frozenset({"pose", "fused"})
"""Modes that use the tracker where there is one."""

_UNITS = {"percent": "%", "mm": "mm", "deg": "°", "s": "s"}


def words_of(key: str) -> str:
    """Words and unit from a key: ``length_error_mm`` is "length error / mm"."""
    name, _, unit = key.rpartition("_")
    return f"{name.replace('_', ' ')} / {_UNITS[unit]}" if unit in _UNITS else key.replace("_", " ")


def number(key: str, value: float | None, signed: bool = False) -> str:
    """Write a value with the digits of its quantity; a dash for none."""
    if value is None or not np.isfinite(value):
        return "-"
    # From one frame to the next hundredths of a millimetre are already large.
    digits = 4 if key[:3] in ("LPE", "LLE") else 1 if key.endswith(("percent", "_s")) else 2
    return f"{value:{'+' if signed else ''}.{digits}f}"


def with_interval(row: Row, name: str, signed: bool = False) -> str:
    """Write the value of that name in a record, and its 95 % interval if it has one."""
    text, low, high = (number(row["quantity"], row[key], signed) for key in (name, "low", "high"))
    return text if row["low"] is None else f"{text} [{low}, {high}]"


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
        bootstrap interval; nothing of a mode that fewer than `FEWEST` sweeps have.
    comparisons : list of dict
        ``quantity``, ``mode``, ``against``, ``sweeps`` that have both, ``difference`` (mean of mode less
        against), ``low``, ``high``, ``wilcoxon_p``, ``holm_p``, and ``better``: the mode with less error,
        None where they are not told apart.
    """
    intervals: list[dict[str, Any]] = []
    comparisons: list[dict[str, Any]] = []
    for quantity in QUANTITIES:
        values = _by_mode(quantity, rows if quantity in ERRORS else drift)
        for mode, by_sweep in values.items():
            interval = mean_interval([*by_sweep.values()])
            intervals.append({"quantity": quantity, "mode": mode, **interval})
        comparisons += _compare_pairs(quantity, values)
    return intervals, comparisons


def overall_text(intervals: Sequence[Row], comparisons: Sequence[Row], references: Mapping[str, str]) -> str:
    """Table of means and intervals, what they are, and the modes that are told apart; empty without any.

    Parameters
    ----------
    references : mapping of str to str
        What each sweep was compared with.
    """
    if not intervals:
        return ""
    quantities = {row["quantity"] for row in intervals}
    words = [
        "[..]: 95 % interval over sweeps, by bootstrap",
        *(f"{key.partition('_')[0]}: {meaning}" for key, meaning in MEANINGS.items() if key in quantities),
        *better_modes(comparisons),
        reference_words({row["mode"] for row in intervals}, references),
    ]
    lines = (textwrap.fill(text, 100, subsequent_indent="  ") for text in words if text)
    return text_table(means_table(intervals), (0, 1, 2)) + "".join(f"{line}\n" for line in lines)


def means_table(intervals: Sequence[Row]) -> list[list[str]]:
    """Cells of means and intervals: heads, then a line for each quantity and mode."""
    return [
        ["mean over sweeps", "mode", "mean", "sweeps"],
        *(
            [words_of(row["quantity"]), row["mode"], with_interval(row, "mean"), str(row["sweeps"])]
            for row in intervals
        ),
    ]


def better_modes(comparisons: Sequence[Row]) -> list[str]:
    """Significant differences of modes, a line for each pair; one line if there are none."""
    less: dict[str, list[str]] = {}
    for row in comparisons:
        if row["better"]:
            worse = row["against"] if row["better"] == row["mode"] else row["mode"]
            name = words_of(row["quantity"]).partition(" /")[0]
            less.setdefault(f"{row['better']} than {worse}", []).append(name)
    if not less:
        return ["no two modes are told apart by these sweeps"] if comparisons else []
    lines = [f"less {', '.join(names)}: {modes}" for modes, names in less.items()]
    return [*lines, f"(told apart sweep by sweep: signed-rank p <= {LEVEL:g} after Holm's correction)"]


def reference_words(modes: Collection[str], references: Mapping[str, str]) -> str:
    """References of the sweeps, and the modes that were fitted to them; empty without any."""
    names = sorted({*references.values()} - {"none"})
    words = f"reference{'s' * (len(names) > 1)}: {', '.join(names)}" if names else ""
    words += "; the means mix errors against both" * (len(names) > 1)
    circular = sorted(FITTED_TO_TRACKER.intersection(modes))
    if circular and "tracker" in names:
        words += f"; fitted to it, so that errors say how well they fit: {', '.join(circular)}"
    return words


def _by_mode(quantity: str, rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Mean magnitude by mode and sweep; modes of fewer than `FEWEST` sweeps are left out."""
    sizes: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        value = row.get(quantity)
        if value is not None and np.isfinite(value):
            sizes.setdefault(row["mode"], {}).setdefault(row["sweep"], []).append(abs(value))
    return {
        mode: {sweep: float(np.mean(values)) for sweep, values in by_sweep.items()}
        for mode, by_sweep in sizes.items()
        if len(by_sweep) >= FEWEST
    }


def _compare_pairs(quantity: str, values: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for mode, against in combinations(values, 2):
        first, second = values[mode], values[against]
        differences = [first[sweep] - second[sweep] for sweep in first if sweep in second]
        if len(differences) >= FEWEST:
            row = mean_interval(differences)
            row |= {"difference": row.pop("mean"), "wilcoxon_p": signed_rank_p(differences)}
            rows.append({"quantity": quantity, "mode": mode, "against": against, **row})
    for row, holm_p in zip(rows, holm([row["wilcoxon_p"] for row in rows]), strict=True):
        differ = holm_p is not None and holm_p <= LEVEL and not row["low"] <= 0 <= row["high"]
        better = row["mode" if row["difference"] < 0 else "against"]
        row |= {"holm_p": holm_p, "better": better if differ else None}
    return rows
