"""Results of a comparison on file: of one sweep (``summary.json``) and of a whole study (``study.json``).

Beside each lie ``table.txt`` for people and ``table.csv``.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json

from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.core.tables import text_table
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.overall import FITTED_TO_TRACKER, over_sweeps, overall_text, shared_means

FORMAT = "speckle3d.study"
VERSION = 1

FILES = FileSet(
    "study.json",
    ("table.txt", "table.csv"),
    ("report.html", "figures/overview.png", "figures/overview.svg", "paper.txt", "paper.json"),
)
"""What a study writes, and what is made from it afterwards."""

_COLUMNS = (
    ("sweep", "sweep", "{}"),
    ("part", "part", "{}"),
    ("mode", "mode", "{}"),
    ("reference", "reference", "{}"),
    ("reference_mm", "reference mm", "{:.2f}"),
    ("estimate_mm", "estimate mm", "{:.2f}"),
    ("length_error_mm", "length error mm", "{:+.2f}"),
    ("length_error_percent", "length error %", "{:+.1f}"),
    ("tilt_error_deg", "tilt error deg", "{:+.2f}"),
    ("yaw_error_deg", "yaw error deg", "{:+.2f}"),
    ("roll_error_deg", "roll error deg", "{:+.2f}"),
    ("remark", "remark", "{}"),
)
TOLD_JITTER_PERCENT = 1.0
"""From here on a length that rests on the tracker says what its jitter does."""
_TO_THE_LEFT = (0, 1, 2, 3, 11)


@dataclass(frozen=True)
class Summary:
    """Errors of one sweep.

    Attributes
    ----------
    reference : str
        What the modes were compared with: "truth", "tracker" or "none".
    coverage : float
        Share of the frames that have a reference.
    rows : sequence of ModeError
    doubts : sequence of Doubt
        About the recording.
    doubted : mapping of str to str
        Modes that rest on a sensor in doubt, and what is suspected.
    left_out : mapping of str to str
        Modes that were asked for and refused, and why.
    claims : mapping of str to float
        Relative standard deviation of the length that a mode claims, where it claims one.
    jitter_percent : float
        What the tracker's jitter alone leaves of error in a length that rests on it; 0 without a tracker.
    details : dict
        Anything else worth keeping, by name: dataclasses, numbers, strings, arrays.
    """

    sweep: str
    reference: str
    frames: int
    coverage: float
    rows: Sequence[ModeError]
    details: dict[str, Any] = field(default_factory=dict)
    doubts: Sequence[Doubt] = ()
    doubted: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    claims: Mapping[str, float] = field(default_factory=dict)
    jitter_percent: float = 0.0

    @property
    def doubt_lines(self) -> list[str]:
        """What a reader must know of the recording, a line each."""
        lines = [f"{self.sweep}: {doubt.consequence}" for doubt in self.doubts]
        return lines + [f"{self.sweep}: mode {mode} is left out" for mode in self.left_out]


@dataclass(frozen=True)
class SweepOutcome:
    """What became of one sweep; `status` is "done" or "failed", and `reason` says why it failed."""

    name: str
    path: Path
    status: str
    reason: str = ""
    sha256: str = ""
    key: str = ""
    folder: str = ""
    seconds: float = 0.0
    frames: int = 0
    skipped: bool = False


@dataclass(frozen=True)
class Study:
    """What a study found, and where it is.

    Attributes
    ----------
    copies : mapping of str to str
        Sweeps whose bytes are those of an earlier one, and that one; statistics over sweeps leave them out.
    """

    directory: Path
    outcomes: Sequence[SweepOutcome]
    summaries: Sequence[Summary]
    drift: Sequence[Mapping[str, Any]]
    table: str
    copies: Mapping[str, str] = field(default_factory=dict)


def write_summary(directory: Path, summary: Summary) -> list[Path]:
    """Write ``summary.json``, ``table.txt`` and ``table.csv``; each appears whole or not at all.

    Raises
    ------
    FileError
        If the directory cannot be written.
    """
    rows = rows_of([summary])
    texts = {"summary.json": json_text({"sweeps": [summary]}), "table.txt": summary_text(summary)}
    return write_texts(directory, texts | {"table.csv": csv_text(rows)})


def summary_text(summary: Summary) -> str:
    """Table of one sweep, and below it what is in doubt."""
    return table_text(rows_of([summary])) + "".join(f"{line}\n" for line in summary.doubt_lines)


def write_study(directory: Path, outcomes: Sequence[SweepOutcome], settings_toml: str) -> Study:
    """Gather what is in the sweeps' folders, and write ``study.json``, ``table.txt`` and ``table.csv``.

    They replace those of an earlier study together; its report is removed.

    Raises
    ------
    FileError
        If the folder cannot be written.
    """
    summaries: list[Summary] = []
    drift: list[dict[str, Any]] = []
    for outcome in outcomes:
        if outcome.status == "done":
            folder = directory / outcome.folder
            summaries.append(_read_summary(folder, outcome.name))
            found = json.loads((folder / "drift.json").read_text(encoding="utf-8"))
            drift += [{"sweep": outcome.name} | row for row in found]
    rows, copies = rows_of(summaries), copies_among(outcomes)
    single = [[row for row in some if row["sweep"] not in copies] for some in (rows, drift)]
    intervals, paired = over_sweeps(*single)
    shared = shared_means(*single)
    references = {each.sweep: each.reference for each in summaries if each.sweep not in copies}
    overall = overall_text(intervals, paired, shared, references)
    failed = [each for each in outcomes if each.status == "failed"]
    remarks = [f"{each.name}  failed: {each.reason}" for each in failed] + copy_lines(copies)
    remarks += [line for each in summaries for line in each.doubt_lines]
    table = table_text(rows) + "".join(f"{line}\n" for line in remarks)
    table += f"\n{overall}" if overall else ""
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "settings_toml": settings_toml,
        "modes": list(dict.fromkeys(row["mode"] for row in rows)),
        "sweeps": [
            {name: value for name, value in asdict(each).items() if name != "skipped"}
            | {"copy_of": copies.get(each.name, "")}
            for each in outcomes
        ],
        "rows": rows,
        "doubts": [{"sweep": each.sweep, **asdict(doubt)} for each in summaries for doubt in each.doubts],
        "drift": drift,
        "intervals": intervals,
        "shared": shared,
        "paired": paired,
    }
    paths = {each.name: each.path for each in outcomes}
    lines = [row | {"path": paths[row["sweep"]], "copy_of": copies.get(row["sweep"], "")} for row in rows]
    lines += [{"sweep": each.name, "path": each.path, "reason": each.reason} for each in failed]
    texts = {"study.json": json_text(contents), "table.txt": table}
    with FILES.replaced(directory) as part:
        write_texts(part, texts | {"table.csv": csv_text(lines, "path", "copy_of", "reason")})
    return Study(directory, outcomes, summaries, drift, table, copies)


def is_study(directory: Path) -> bool:
    """Whether a folder holds a study; a file of that name and other content is none."""
    try:
        return bool(json.loads((directory / FILES.primary).read_text(encoding="utf-8"))["format"] == FORMAT)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def require_own_study(directory: Path) -> None:
    """Refuse a folder in which a study's names stand for something else.

    Raises
    ------
    InvalidInputError
        Naming the first such file.
    """
    held = [name for name in FILES.names if (directory / name).exists()]
    if held and not is_study(directory):
        raise InvalidInputError(
            f"{directory / held[0]}: expected a new folder or a study to go on with or to replace, "
            "got a file of another origin"
        )


def rows_of(summaries: Sequence[Summary]) -> list[dict[str, Any]]:
    """One record per sweep, part and mode."""
    return [
        {"sweep": each.sweep, "reference": each.reference, **asdict(row), "remark": remark_on(each, row)}
        for each in summaries
        for row in each.rows
    ]


def remark_on(summary: Summary, row: ModeError) -> str:
    """What a reader of a row must know beside its numbers; empty for nothing."""
    words = []
    if row.mode in summary.claims:
        words.append(f"length +- {100 * summary.claims[row.mode]:.1f} %")
    rests_on_tracker = row.mode in FITTED_TO_TRACKER or summary.reference == "tracker"
    if rests_on_tracker and summary.jitter_percent >= TOLD_JITTER_PERCENT:
        words.append(f"tracker's jitter alone +- {summary.jitter_percent:.1f} %")
    if row.mode in FITTED_TO_TRACKER and summary.reference == "tracker":
        words.append("fitted to this tracker")
    if row.mode in summary.doubted:
        words.append(f"in doubt: {summary.doubted[row.mode]}")
    return "; ".join(words)


def table_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Aligned table of `rows_of` for reading; angles and lengths are estimate minus reference."""
    lines = [[heading for _, heading, _ in _COLUMNS]]
    lines += [[_cell(row[key], form) for key, _, form in _COLUMNS] for row in rows]
    if not any(line[-1] for line in lines[1:]):
        lines = [line[:-1] for line in lines]
    return text_table(lines, _TO_THE_LEFT)


def csv_text(rows: Sequence[Mapping[str, Any]], *more: str) -> str:
    """`rows_of` with full precision, under the names of `ModeError`, and `more` columns behind."""
    columns = ["sweep", "reference", *(f.name for f in fields(ModeError)), "remark", *more]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def json_text(value: Any) -> str:
    """Dataclasses, arrays and numbers as strict JSON: a value that is not finite becomes null.

    Characters that could drive a terminal are escaped.

    Raises
    ------
    InvalidInputError
        If there is anything else in it.
    """
    try:
        text = to_json(value, indent=2, inf_nan_mode="null", fallback=_listed).decode()
    except ValueError as error:
        raise InvalidInputError(f"summary: expected what JSON can hold: {error}") from error
    plain = (c if c == "\n" or printable(c) == c else json.dumps(c)[1:-1] for c in text)
    return f"{text if text.isascii() else ''.join(plain)}\n"


def copies_among(outcomes: Sequence[SweepOutcome]) -> dict[str, str]:
    """Sweeps whose bytes are those of an earlier one, and that one's name."""
    first: dict[str, str] = {}
    copies: dict[str, str] = {}
    for each in outcomes:
        if each.status == "done" and first.setdefault(each.sha256, each.name) != each.name:
            copies[each.name] = first[each.sha256]
    return copies


def copy_lines(copies: Mapping[str, str]) -> list[str]:
    """Say which sweeps were left out of what is counted over sweeps."""
    return [f"{name} is a copy of {first}: counted once" for name, first in copies.items()]


def _read_summary(folder: Path, name: str) -> Summary:
    """Read a sweep's rows back; a number that was not finite is NaN again."""
    held: dict[str, Any]
    (held,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    names = [f.name for f in fields(ModeError)]
    rows: list[list[Any]] = [[math.nan if row[n] is None else row[n] for n in names] for row in held["rows"]]
    summary = held["reference"], held["frames"], held["coverage"]
    doubts = [Doubt(**each) for each in held.get("doubts", ())]
    told: dict[str, Any] = {key: held.get(key, {}) for key in ("doubted", "left_out", "claims")}
    told["jitter_percent"] = held.get("jitter_percent") or 0.0
    return Summary(name, *summary, [ModeError(*values) for values in rows], doubts=doubts, **told)


def _cell(value: Any, form: str) -> str:
    return "-" if isinstance(value, float) and math.isnan(value) else form.format(value)


def _listed(value: Any) -> Any:
    """Arrays and NumPy scalars as lists and numbers of Python's own, for `to_json`."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise ValueError(f"got {type(value)}")


def write_texts(directory: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts under their names; each appears whole or not at all."""
    make_folder(directory)
    for name, text in texts.items():
        with atomic_path(directory / name) as part:
            part.write_text(text, encoding="utf-8")
    return [directory / name for name in texts]
