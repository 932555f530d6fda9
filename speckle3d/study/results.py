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

from speckle3d.core.errors import Doubt, InvalidInputError
from speckle3d.core.reconstruction import Provenance
from speckle3d.core.text import text_table
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import atomic_path, make_folder, require_target
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
    left_out: Mapping[str, str] = field(default_factory=dict)
    claims: Mapping[str, float] = field(default_factory=dict)
    drift: Sequence[Mapping[str, Any]] = ()

    @property
    def lines(self) -> list[str]:
        """Notes below the table: doubts, modes left out, and remarks on rows."""
        remarks = dict.fromkeys(f"{row.mode}: {self.remark(row)}" for row in self.rows if self.remark(row))
        left_out = (f"mode {mode} is left out" for mode in self.left_out)
        words = (*(str(doubt) for doubt in self.doubts), *left_out, *remarks)
        return [f"{self.sweep}: {text}" for text in words]

    def remark(self, row: ModeError) -> str:
        """Remark on a row; empty for none."""
        words = []
        if row.mode == self.reference:
            words.append("the reference itself")
        if row.mode in FITTED_TO_TRACKER and self.reference == "tracker":
            words.append("fitted to this tracker")
        return "; ".join(words)

    def records(self) -> list[dict[str, Any]]:
        """Rows with ``sweep``, ``reference`` and ``remark`` beside their errors."""
        names = {"sweep": self.sweep, "reference": self.reference}
        return [names | asdict(row) | {"remark": self.remark(row)} for row in self.rows]


@dataclass(frozen=True)
class SweepOutcome:
    """Plan and outcome of one sweep: a summary, or a reason why there is none.

    Attributes
    ----------
    folder : str
        In the study's; empty of a sweep that failed.
    is_old : bool
        Whether the folder was there before.
    """

    name: str
    path: Path
    reason: str = ""
    sha256: str = ""
    key: str = ""
    folder: str = ""
    frames: int = 0
    is_old: bool = False
    summary: Summary | None = None

    def record(self) -> dict[str, Any]:
        """The outcome as ``study.json`` has it."""
        values = {name: value for name, value in vars(self).items() if name not in ("is_old", "summary")}
        seconds = self.summary.details["seconds"] if self.summary else 0.0
        return values | {"status": "done" if self.summary else "failed", "seconds": seconds}


@dataclass(frozen=True)
class Study:
    """Outcomes of a study's sweeps, and its folder."""

    directory: Path
    outcomes: Sequence[SweepOutcome]
    settings_toml: str

    @property
    def successes(self) -> list[SweepOutcome]:
        """Sweeps with results."""
        return [outcome for outcome in self.outcomes if outcome.summary]

    @property
    def failures(self) -> list[SweepOutcome]:
        """Sweeps without results."""
        return [outcome for outcome in self.outcomes if not outcome.summary]

    @property
    def summaries(self) -> list[Summary]:
        """Summaries of the sweeps with results."""
        return [outcome.summary for outcome in self.outcomes if outcome.summary]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Errors by sweep, part and mode."""
        return [record for summary in self.summaries for record in summary.records()]

    @cached_property
    def drift(self) -> list[dict[str, Any]]:
        """Drift by sweep and mode."""
        return [{"sweep": summary.sweep, **row} for summary in self.summaries for row in summary.drift]

    @property
    def doubts(self) -> list[dict[str, Any]]:
        """Doubts about the recordings, by sweep."""
        return [{"sweep": s.sweep, **asdict(doubt)} for s in self.summaries for doubt in s.doubts]

    @cached_property
    def statistics(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Means over sweeps by mode, and modes compared in pairs, as `over_sweeps`."""
        return over_sweeps(self.rows, self.drift)

    @property
    def table(self) -> str:
        """All sweeps' errors, remarks and statistics as text."""
        failures = [f"{outcome.name}  failed: {outcome.reason}" for outcome in self.failures]
        overall = overall_text(*self.statistics, {s.sweep: s.reference for s in self.summaries})
        return summary_text(self.summaries, failures) + (f"\n{overall}" if overall else "")


def write_summary(directory: Path, summary: Summary) -> None:
    """Write ``summary.json``, ``table.txt`` and ``table.csv``; each appears whole or not at all.

    Raises
    ------
    FileError
        If the directory cannot be written.
    """
    texts = json_text({"sweeps": [summary]}), summary_text([summary]), csv_text(summary.records())
    write_texts(directory, dict(zip(SUMMARY_FILES, texts, strict=True)))


def summary_text(summaries: Sequence[Summary], failures: Sequence[str] = ()) -> str:
    """Table of some sweeps, under 100 columns for names of usual length, and notes below it."""
    records = [record for summary in summaries for record in summary.records()]
    names = dict.fromkeys(summary.reference for summary in summaries)
    lines = [
        "part: f forward, r back, all; +- 95 %: of length in mm, as the mode claims, of tracker by its jitter"
    ]
    if set(names) - {"none"}:
        lines.append(f"reference: {', '.join(names)}; errors are estimate minus reference")
    lines += [*(line for summary in summaries for line in summary.lines), *failures]
    cells: list[Sequence[str]] = [_HEADS]
    for row in records:
        half = None if row["sigma_mm"] is None else 1.96 * row["sigma_mm"]
        lengths = [number("mm", value) for value in (row["estimate_mm"], half, row["reference_mm"])]
        errors = [
            number(key, row[key], signed=True)
            for key in ("length_error_percent", "tilt_error_deg", "yaw_error_deg", "roll_error_deg")
        ]
        cells.append([row["sweep"], row["part"], row["mode"], *lengths, *errors])
    return text_table(cells, (0, 1, 2)) + "".join(f"{line}\n" for line in lines)


def csv_text(records: Sequence[Mapping[str, Any]], *extra_columns: str) -> str:
    """`Summary.records` with full precision."""
    columns = ["sweep", "reference", *(f.name for f in fields(ModeError)), "remark", *extra_columns]
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
    intervals, comparisons = study.statistics
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "settings_toml": study.settings_toml,
        "modes": list(dict.fromkeys(row["mode"] for row in study.rows)),
        "sweeps": [outcome.record() for outcome in study.outcomes],
        "rows": study.rows,
        "doubts": study.doubts,
        "drift": study.drift,
        "intervals": intervals,
        "paired": comparisons,
    }
    lines = [*study.rows, *({"sweep": o.name, "reason": o.reason} for o in study.failures)]
    texts = {"study.json": json_text(contents), "table.txt": study.table}
    with FILES.replaced(study.directory) as part:
        write_texts(part, texts | {"table.csv": csv_text(lines, "reason")})


def require_own(directory: Path, files: FileSet) -> None:
    """Refuse a folder that cannot be written, or in which names of a result stand for something else.

    Raises
    ------
    InvalidInputError
        Naming the first such file.
    """
    base = next(path for path in (directory, *directory.absolute().parents) if path.exists())
    if not base.is_dir():
        raise InvalidInputError(f"{directory}: expected a folder or a new name, got the file {base.name}")
    require_target(base / files.primary)
    names = [name for name in files.names if (directory / name).exists()]
    if names and files.primary not in names:
        raise InvalidInputError(
            f"{directory / names[0]}: expected a new folder, or one with {files.primary} to replace, got a "
            "file of another origin"
        )


def json_text(value: Any) -> str:
    """Dataclasses, arrays and numbers as strict JSON in ASCII: a value that is not finite becomes null."""
    text = to_json(value, inf_nan_mode="null", fallback=lambda array: array.tolist())
    return f"{json.dumps(json.loads(text), indent=2)}\n"


def read_summary(folder: Path, name: str) -> Summary:
    """Read a sweep's summary back, its details as JSON has them; what was not finite in rows is NaN again."""
    (record,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    values: list[dict[str, Any]] = [
        {key: math.nan if value is None else value for key, value in row.items()} for row in record["rows"]
    ]
    rows = [ModeError(**row) for row in values]
    doubts = [Doubt(**doubt) for doubt in record["doubts"]]
    record.pop("doubted", None)  # of older versions
    return Summary(**record | {"sweep": name, "rows": rows, "doubts": doubts})


def recorded_doubts(path: Path, provenance: Provenance) -> tuple[Doubt, ...] | None:
    """Read the doubts in the ``summary.json`` beside a reconstruction.

    Parameters
    ----------
    path : path
        The reconstruction's file.
    provenance : Provenance
        Of the reconstruction: a summary of another recording does not count.

    Returns
    -------
    tuple of Doubt, or None
        None if no summary of this reconstruction is there.
    """
    try:
        summary = read_summary(path.parent, "")
        input_sha256 = summary.details["provenance"]["input_sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return tuple(summary.doubts) if input_sha256 == provenance.input_sha256 else None


def write_texts(directory: Path, texts: Mapping[str, str]) -> None:
    """Write texts under their names; each appears whole or not at all."""
    make_folder(directory)
    for name, text in texts.items():
        with atomic_path(directory / name) as part:
            part.write_text(text, encoding="utf-8")
