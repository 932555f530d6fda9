"""What the report says of all sweeps together: its first sentences, and tables of intervals and of pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from speckle3d.study.overall import QUANTITIES, Quantity, beats
from speckle3d.study.report_figures import label_of
from speckle3d.study.report_page import plain_table

Row = Mapping[str, Any]

_LENGTH, _TILT = "length_error_percent", "tilt_error_deg"


def summary_lines(
    means: Sequence[Row], scored: Sequence[Row], done: int, broken: int, paired: Sequence[Row] = ()
) -> list[str]:
    """Say in plain sentences which mode is right, by how much, and whether the sweeps can tell.

    Parameters
    ----------
    means : sequence of mapping
        Mean magnitude of each error by mode.
    scored : sequence of mapping
        Rows that have a reference.
    done, broken : int
        Number of sweeps with and without results.
    paired : sequence of mapping
        Modes compared in pairs, as in ``study.json``.
    """
    if not done:
        return [f"Nothing could be reconstructed from {counted(broken, 'sweep')}; the reasons are below."]
    lines = []
    best, straightest = best_of(means, "length_percent"), best_of(means, "tilt_deg")
    if best is None:
        lines.append(
            "No sweep has a reference, so no mode can be called right: the lengths below are estimates alone."
        )
    else:
        lines.append(_length_line(means, scored, best) + _doubt(means, paired, _LENGTH, best))
        if straightest is not None:
            tilts = ", ".join(f"{label_of(row['mode'])} {row['tilt_deg']:.2f}°" for row in means)
            lines.append(
                f"In tilt {label_of(straightest)} is closest. Mean tilt error: {tilts}."
                + _doubt(means, paired, _TILT, straightest)
            )
    if broken:
        lines.append(f"{broken} of {done + broken} sweeps could not be reconstructed; the reasons are below.")
    return lines


def intervals_table(intervals: Sequence[Row]) -> str:
    """Mean and interval of every quantity, a column for each mode."""
    modes = list(dict.fromkeys(str(row["mode"]) for row in intervals))
    lines = []
    for quantity in QUANTITIES:
        rows = {row["mode"]: row for row in intervals if row["quantity"] == quantity.key}
        if rows:
            lines.append([_words(quantity), *(_with_interval(quantity, rows.get(mode)) for mode in modes)])
    return plain_table(["mean over sweeps", *map(label_of, modes)], lines)


def paired_table(paired: Sequence[Row]) -> str:
    """Difference of every two modes in every quantity, bold where they are told apart."""
    pairs = list(dict.fromkeys((str(row["mode"]), str(row["against"])) for row in paired))
    lines = []
    for quantity in QUANTITIES:
        rows = {(r["mode"], r["against"]): r for r in paired if r["quantity"] == quantity.key}
        if rows:
            lines.append([_words(quantity), *(_difference(quantity, rows.get(pair)) for pair in pairs)])
    heads = ["difference", *(f"{label_of(one)} − {label_of(other)}" for one, other in pairs)]
    return plain_table(heads, lines)


def best_of(means: Sequence[Row], key: str) -> str | None:
    """Mode with the smallest mean; None without any."""
    valued = [row for row in means if row[key] is not None]
    return str(min(valued, key=lambda row: row[key])["mode"]) if valued else None


def counted(count: int, what: str) -> str:
    """Number and noun."""
    return f"{count} {what}{'s' * (count != 1)}"


def _length_line(means: Sequence[Row], scored: Sequence[Row], best: str) -> str:
    mine = next(row for row in means if row["mode"] == best)
    parts = len({(row.get("sweep"), row.get("part")) for row in scored})
    sweeps = len({row.get("sweep") for row in scored})
    others = [
        f"{row['length_percent']:.1f} % with {label_of(row['mode'])}"
        for row in means
        if row["mode"] != best and row["length_percent"] is not None
    ]
    against = f", against {', '.join(others)}" if others else ""
    return (
        f"Over {counted(parts, 'part')} of {counted(sweeps, 'sweep')}, {label_of(best)} has the smallest "
        f"error of length: {mine['length_percent']:.1f} % on average ({mine['length_mm']:.2f} mm)"
        f"{against}."
    )


def _doubt(means: Sequence[Row], paired: Sequence[Row], quantity: str, best: str) -> str:
    """Say which modes these sweeps do not tell apart from the best."""
    others = [str(row["mode"]) for row in means if row["mode"] != best]
    alike = [mode for mode in others if not beats(paired, quantity, best, mode)]
    if not others:
        return ""
    if not alike:
        return (
            " The sweeps tell it apart from every other mode."
            if len(others) > 1
            else " The sweeps tell them apart."
        )
    if len(alike) == len(others):
        others_named = "the other modes" if len(others) > 1 else label_of(others[0])
        return f" It is not told apart from {others_named} by these sweeps: the difference may be chance."
    return f" It is not told apart from {' and '.join(map(label_of, alike))}: that difference may be chance."


def _words(quantity: Quantity) -> str:
    return escape(
        quantity.words.replace(" deg", " / °").replace(" mm", " / mm").replace("error %", "error / %")
    )


def _with_interval(quantity: Quantity, row: Row | None) -> str:
    if row is None:
        return "–"
    mean = quantity.shown(row["mean"])
    if row["low"] is None:
        return mean
    return f"{mean} ({quantity.shown(row['low'])} to {quantity.shown(row['high'])})"


def _difference(quantity: Quantity, row: Row | None) -> str:
    if row is None:
        return "–"
    text = quantity.shown(row["difference"], signed=True)
    if row["low"] is not None:
        low, high = (quantity.shown(row[end], signed=True) for end in ("low", "high"))
        text += f"<br>({low} to {high})"
    text = text.replace("-", "−")
    return f"<b>{text}</b>" if row["better"] else text
