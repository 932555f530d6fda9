"""Results of a comparison on file: of one sweep (``summary.json``) and of a whole study (``study.json``).

Beside each lie ``table.txt`` for people and ``table.csv``. JSON and CSV hold standard deviations; where
people read, ``+-`` is the half width of a 95 % interval, and says so.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic_core import to_json

from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.tables import text_table
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.overall import FITTED_TO_TRACKER, number, over_sweeps, overall_text

FORMAT = "speckle3d.study"
VERSION = 2
"""Version 1 had its statistics from one sweep on, and the modes' drift in files of their own."""

FILES = FileSet(
    "study.json", ("table.txt", "table.csv"), ("report.html", "overview.png", "paper.txt", "paper.json")
)
"""What a study writes, and what is made from it afterwards."""

SUMMARY_FILES = ("summary.json", "table.txt", "table.csv")

_HEADS = (
    "sweep",
    "part",
    "mode",
    "length/mm",
    "+- 95 %",
    "reference",
    "error/%",
    "tilt/°",
    "yaw/°",
    "roll/°",
)


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
        Of every mode, "tracker" among them: the sensor alone, no images.
    drift : sequence of mapping
        Drift and displacement by ``mode``, as `speckle3d.scoring.displacements.score_row` has them.
    doubts : sequence of Doubt
        About the recording.
    doubted : mapping of str to str
        Modes that rest on a sensor in doubt, and what is suspected.
    left_out : mapping of str to str
        Modes that were asked for and refused, and why.
    claims : mapping of str to float
        Relative standard deviation of the length that a mode claims, where it claims one.
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
    drift: Sequence[Mapping[str, Any]] = ()

    @property
    def lines(self) -> list[str]:
        """What stands below the table: doubts, modes left out, and remarks on rows."""
        remarks = dict.fromkeys(f"{row.mode}: {self.remark(row)}" for row in self.rows if self.remark(row))
        left_out = (f"mode {mode} is left out" for mode in self.left_out)
        words = (*(doubt.consequence for doubt in self.doubts), *left_out, *remarks)
        return [f"{self.sweep}: {each}" for each in words]

    def remark(self, row: ModeError) -> str:
        """What a reader of a row must know beside its numbers; empty for nothing."""
        words = []
        if row.mode == self.reference:
            words.append("the reference itself")
        if row.mode in FITTED_TO_TRACKER and self.reference == "tracker":
            words.append("fitted to this tracker")
        if row.mode in self.doubted:
            words.append(f"in doubt: {self.doubted[row.mode]}")
        return "; ".join(words)

    def records(self) -> list[dict[str, Any]]:
        """Rows with what is known beside their errors: ``sweep``, ``reference`` and ``remark``."""
        known = {"sweep": self.sweep, "reference": self.reference}
        return [known | asdict(row) | {"remark": self.remark(row)} for row in self.rows]


@dataclass(frozen=True)
class SweepOutcome:
    """What is planned for one sweep and became of it; failed without a summary, and `reason` says why."""

    name: str
    path: Path
    reason: str = ""
    sha256: str = ""
    key: str = ""
    folder: str = ""
    frames: int = 0
    skipped: bool = False
    summary: Summary | None = None

    def record(self) -> dict[str, Any]:
        """The outcome as ``study.json`` has it."""
        names = ("name", "path", "reason", "sha256", "key", "folder", "frames")
        seconds = self.summary.details["seconds"] if self.summary else 0.0
        status = "done" if self.summary else "failed"
        return {name: getattr(self, name) for name in names} | {"status": status, "seconds": seconds}


@dataclass(frozen=True)
class Study:
    """What a study found, and where it is."""

    directory: Path
    outcomes: Sequence[SweepOutcome]
    settings_toml: str

    @property
    def done(self) -> list[SweepOutcome]:
        """Sweeps with results."""
        return [each for each in self.outcomes if each.summary]

    @property
    def broken(self) -> list[SweepOutcome]:
        """Sweeps without."""
        return [each for each in self.outcomes if not each.summary]

    @property
    def summaries(self) -> list[Summary]:
        """Of the sweeps with results."""
        return [each.summary for each in self.outcomes if each.summary]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Errors by sweep, part and mode."""
        return [record for each in self.summaries for record in each.records()]

    @cached_property
    def drift(self) -> list[dict[str, Any]]:
        """Drift by sweep and mode."""
        return [{"sweep": each.sweep, **row} for each in self.summaries for row in each.drift]

    @property
    def doubts(self) -> list[dict[str, Any]]:
        """What of the recordings is in doubt, by sweep."""
        return [{"sweep": each.sweep, **asdict(doubt)} for each in self.summaries for doubt in each.doubts]

    @cached_property
    def statistics(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Means over sweeps by mode, and modes compared in pairs, as `over_sweeps`."""
        return over_sweeps(self.rows, self.drift)

    @property
    def table(self) -> str:
        """All sweeps' errors, remarks and statistics as text."""
        failures = [f"{each.name}  failed: {each.reason}" for each in self.broken]
        overall = overall_text(*self.statistics, {each.sweep: each.reference for each in self.summaries})
        return summary_text(self.summaries, failures) + (f"\n{overall}" if overall else "")


def write_summary(directory: Path, summary: Summary) -> list[Path]:
    """Write ``summary.json``, ``table.txt`` and ``table.csv``; each appears whole or not at all.

    Raises
    ------
    FileError
        If the directory cannot be written.
    """
    texts = json_text({"sweeps": [summary]}), summary_text([summary]), csv_text(summary.records())
    return write_texts(directory, dict(zip(SUMMARY_FILES, texts, strict=True)))


def summary_text(summaries: Sequence[Summary], more: Sequence[str] = ()) -> str:
    """Table of some sweeps, below it what its columns are and what is in doubt, then more lines."""
    records = [record for each in summaries for record in each.records()]
    names = dict.fromkeys(each.reference for each in summaries)
    lines = [
        "part: f forward, r back; +- 95 %: of the length, mm, as the mode claims it, of tracker by its jitter"
    ]
    if set(names) - {"none"}:
        lines.append(f"reference: {', '.join(names)}; errors are estimate minus reference")
    lines += [*(line for each in summaries for line in each.lines), *more]
    return table_text(records) + "".join(f"{line}\n" for line in lines)


def table_text(records: Sequence[Mapping[str, Any]]) -> str:
    """Aligned table of `Summary.records` for reading, under 100 columns for names of usual length."""
    lines: list[Sequence[str]] = [_HEADS]
    for row in records:
        half = None if row["sigma_mm"] is None else 1.96 * row["sigma_mm"]
        signed = [
            number(key, row[key], signed=True)
            for key in ("length_error_percent", "tilt_error_deg", "yaw_error_deg", "roll_error_deg")
        ]
        lengths = [number("mm", value) for value in (row["estimate_mm"], half, row["reference_mm"])]
        lines.append([row["sweep"], row["part"], row["mode"], *lengths, *signed])
    return text_table(lines, (0, 1, 2))


def csv_text(records: Sequence[Mapping[str, Any]], *more: str) -> str:
    """`Summary.records` with full precision, and `more` columns behind."""
    columns = ["sweep", "reference", *(f.name for f in fields(ModeError)), "remark", *more]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def write_study(study: Study) -> None:
    """Write ``study.json``, ``table.txt`` and ``table.csv``.

    They replace those of an earlier study together; its report is removed.

    Raises
    ------
    FileError
        If the folder cannot be written.
    """
    intervals, paired = study.statistics
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "settings_toml": study.settings_toml,
        "modes": list(dict.fromkeys(row["mode"] for row in study.rows)),
        "sweeps": [each.record() for each in study.outcomes],
        "rows": study.rows,
        "doubts": study.doubts,
        "drift": study.drift,
        "intervals": intervals,
        "paired": paired,
    }
    lines = [*study.rows, *({"sweep": each.name, "reason": each.reason} for each in study.broken)]
    texts = {"study.json": json_text(contents), "table.txt": study.table}
    with FILES.replaced(study.directory) as part:
        write_texts(part, texts | {"table.csv": csv_text(lines, "reason")})


def require_own(directory: Path, files: FileSet) -> None:
    """Refuse a folder in which names of a result stand for something else.

    Raises
    ------
    InvalidInputError
        Naming the first such file.
    """
    taken = [name for name in files.names if (directory / name).exists()]
    if taken and files.primary not in taken:
        raise InvalidInputError(
            f"{directory / taken[0]}: expected a new folder, or one with {files.primary} to replace, got a "
            "file of another origin"
        )


def json_text(value: Any) -> str:
    """Dataclasses, arrays and numbers as strict JSON in ASCII: a value that is not finite becomes null."""
    text = to_json(value, inf_nan_mode="null", fallback=lambda array: array.tolist())
    return f"{json.dumps(json.loads(text), indent=2)}\n"


def read_summary(folder: Path, name: str) -> Summary:
    """Read a sweep's summary back, of its details the time alone; what was not finite is NaN again."""
    (stored,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    records: list[dict[str, Any]] = [
        {key: math.nan if value is None else value for key, value in row.items()} for row in stored["rows"]
    ]
    rows = [ModeError(**record) for record in records]
    doubts = [Doubt(**each) for each in stored["doubts"]]
    details = {"seconds": stored["details"]["seconds"]}
    return Summary(**stored | {"sweep": name, "rows": rows, "doubts": doubts, "details": details})


def write_texts(directory: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts under their names; each appears whole or not at all."""
    make_folder(directory)
    for name, text in texts.items():
        with atomic_path(directory / name) as part:
            part.write_text(text, encoding="utf-8")
    return [directory / name for name in texts]
