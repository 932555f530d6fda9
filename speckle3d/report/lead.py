"""The report's first sentences: which mode has the smallest errors, and whether the sweeps can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from speckle3d.study.figures import label_of
from speckle3d.study.overall import beats, fitted_to_reference, mean_over_sweeps, reference_words

Row = Mapping[str, Any]

_LENGTH, _TILT = "length_error_percent", "tilt_error_deg"
_ERRORS = {
    "length_error_mm": "length_mm",
    "length_error_percent": "length_percent",
    "tilt_error_deg": "tilt_deg",
    "yaw_error_deg": "yaw_deg",
    "roll_error_deg": "roll_deg",
}


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


def scored_means(rows: Sequence[Row], modes: Sequence[str]) -> Scored:
    """Means by mode over the sweeps that have all modes; where none has, over each mode's own.

    Parameters
    ----------
    rows : sequence of mapping
        Errors by sweep, part and mode, copies left out.
    """
    scored = [row for row in rows if row.get("length_error_mm") is not None]
    modes = [mode for mode in modes if any(row["mode"] == mode for row in scored)]
    whole = [s for s, held in _modes_by_sweep(scored).items() if held.issuperset(modes)]
    used = [row for row in scored if row["sweep"] in whole] or scored
    means = []
    for mode in modes:
        mine = [row for row in used if row["mode"] == mode]
        values = {short: mean_over_sweeps(mine, key) for key, short in _ERRORS.items()}
        held = {short: value if np.isfinite(value) else None for short, value in values.items()}
        means.append({"mode": mode, "sweeps": len({row["sweep"] for row in mine}), **held})
    parts = len({(row["sweep"], row["part"]) for row in used})
    left_out = len({row["sweep"] for row in scored}) - len(whole)
    return Scored(means, parts, bool(whole) or not scored, left_out)


def summary_lines(
    scored: Scored,
    done: int,
    broken: int,
    paired: Sequence[Row] = (),
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
        lines.append(_length_line(scored, best) + _doubt(means, paired, _LENGTH, best))
        if straightest is not None:
            tilts = ", ".join(
                f"{label_of(row['mode'])} {row['tilt_deg']:.2f}°"
                for row in means
                if row["tilt_deg"] is not None
            )
            lines.append(
                f"In tilt {label_of(straightest)} is closest. Mean tilt error: {tilts}."
                + _doubt(means, paired, _TILT, straightest)
            )
    lines += _reference_lines(means, references or {})
    if broken:
        lines.append(f"{broken} of {done + broken} sweeps could not be reconstructed; the reasons are below.")
    return lines


def _modes_by_sweep(scored: Sequence[Row]) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for row in scored:
        found.setdefault(str(row["sweep"]), set()).add(str(row["mode"]))
    return found


def _reference_lines(means: Sequence[Row], references: Mapping[str, str]) -> list[str]:
    words = reference_words(references)
    lines = [f"{words[0].upper()}{words[1:]}."] if words else []
    if fitted_to_reference({row["mode"] for row in means}, references):
        lines.append(
            f"{label_of('pose')[0].upper()}{label_of('pose')[1:]} was fitted to the tracker that it is "
            "compared with: its errors say how well it fits, not how right it is."
        )
    return lines


def best_of(means: Sequence[Row], key: str) -> str | None:
    """Mode with the smallest mean; None without any."""
    valued = [row for row in means if row[key] is not None]
    return str(min(valued, key=lambda row: row[key])["mode"]) if valued else None


def counted(count: int, what: str) -> str:
    """Number and noun."""
    return f"{count} {what}{'s' * (count != 1)}"


def _length_line(scored: Scored, best: str) -> str:
    means = scored.means
    mine = next(row for row in means if row["mode"] == best)
    others = [
        f"{row['length_percent']:.1f} % with {label_of(row['mode'])}"
        for row in means
        if row["mode"] != best and row["length_percent"] is not None
    ]
    against = f", against {', '.join(others)}" if others else ""
    which = f" that {'has' if mine['sweeps'] == 1 else 'have'} every mode" if scored.left_out else ""
    return (
        f"Over {counted(mine['sweeps'], 'sweep')}{which} ({counted(scored.parts, 'part')}), {label_of(best)} "
        f"has the smallest error of length: {mine['length_percent']:.1f} % on average over sweeps "
        f"({mine['length_mm']:.2f} mm){against}."
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
