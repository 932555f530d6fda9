"""What a study writes of all its sweeps together: ``study.json`` and the tables."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from speckle3d.io.hdf5 import atomic_path
from speckle3d.report.data import FORMAT, VERSION
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.overall import over_sweeps, overall_text, shared_means
from speckle3d.study.summary import Summary, csv_text, plain, remark_on, table_text
from speckle3d.study.sweepjob import SweepOutcome


@dataclass(frozen=True)
class Study:
    """What a study found, and where it is.

    Attributes
    ----------
    copies : mapping of str to str
        Sweeps of the same bytes as one before them, which statistics over sweeps leave out, and that one.
    """

    directory: Path
    outcomes: Sequence[SweepOutcome]
    summaries: Sequence[Summary]
    drift: Sequence[Mapping[str, Any]]
    table: str
    copies: Mapping[str, str] = field(default_factory=dict)


def write_study(directory: Path, outcomes: Sequence[SweepOutcome], settings_toml: str) -> Study:
    """Gather what is in the sweeps' folders, and write ``study.json``, ``table.txt`` and ``table.csv``.

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
            rows = json.loads((folder / "drift.json").read_text(encoding="utf-8"))
            drift += [{"sweep": outcome.name} | row for row in rows]
    rows = [
        {"sweep": each.sweep, "reference": each.reference, **asdict(row), "remark": remark_on(each, row)}
        for each in summaries
        for row in each.rows
    ]
    copies = copies_among(outcomes)
    single = (
        [row for row in rows if row["sweep"] not in copies],
        [row for row in drift if row["sweep"] not in copies],
    )
    intervals, paired = over_sweeps(*single)
    shared = shared_means(*single)
    table = table_text(summaries) + "".join(
        f"{each.name}  failed: {each.reason}\n" for each in outcomes if each.status == "failed"
    )
    references = {each.sweep: each.reference for each in summaries if each.sweep not in copies}
    table += "".join(f"{line}\n" for line in copy_lines(copies))
    if overall := overall_text(intervals, paired, shared, references):
        table += f"\n{overall}"
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "settings_toml": settings_toml,
        "modes": list(dict.fromkeys(row["mode"] for row in rows)),
        "sweeps": [_entry(outcome, copies) for outcome in outcomes],
        "rows": rows,
        "drift": drift,
        "intervals": intervals,
        "shared": shared,
        "paired": paired,
    }
    texts = {
        "study.json": json.dumps(plain(contents), indent=2, allow_nan=False) + "\n",
        "table.txt": table,
        "table.csv": _csv(summaries, outcomes, copies),
    }
    for name, text in texts.items():
        with atomic_path(directory / name) as part:
            part.write_text(text, encoding="utf-8")
    return Study(directory, outcomes, summaries, drift, table, copies)


def copies_among(outcomes: Sequence[SweepOutcome]) -> dict[str, str]:
    """Sweeps that are copies of one before them, byte by byte, and which: they tell nothing of their own."""
    first: dict[str, str] = {}
    copies: dict[str, str] = {}
    for each in outcomes:
        if each.status == "done" and first.setdefault(each.sha256, each.name) != each.name:
            copies[each.name] = first[each.sha256]
    return copies


def copy_lines(copies: Mapping[str, str]) -> list[str]:
    """Say which sweeps were left out of what is counted over sweeps."""
    return [f"{name} is a copy of {first}: counted once" for name, first in copies.items()]


def _entry(outcome: SweepOutcome, copies: Mapping[str, str]) -> dict[str, Any]:
    shown = asdict(outcome) | {"path": str(outcome.path), "copy_of": copies.get(outcome.name, "")}
    return {name: value for name, value in shown.items() if name != "skipped"}


def _read_summary(folder: Path, name: str) -> Summary:
    """Read a sweep's rows back; a number that was not finite is NaN again."""
    held: dict[str, Any]
    (held,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    names = [f.name for f in fields(ModeError)]
    rows: list[dict[str, Any]] = [
        {name: float("nan") if row[name] is None else row[name] for name in names} for row in held["rows"]
    ]
    return Summary(
        name, held["reference"], held["frames"], held["coverage"], [ModeError(**row) for row in rows]
    )


def _csv(summaries: Sequence[Summary], outcomes: Sequence[SweepOutcome], copies: Mapping[str, str]) -> str:
    """All rows with their files, and one for each sweep that failed, with its reason."""
    lines = list(csv.reader(io.StringIO(csv_text(summaries))))
    width = len(lines[0])
    paths = {each.name: str(each.path) for each in outcomes}
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*lines[0], "path", "copy_of", "reason"])
    writer.writerows([*line, paths[line[0]], copies.get(line[0], ""), ""] for line in lines[1:])
    for each in outcomes:
        if each.status == "failed":
            writer.writerow([each.name, *[""] * (width - 1), paths[each.name], "", each.reason])
    return text.getvalue()
