"""A comparison's numbers on file: for programs (JSON, CSV) and for people (an aligned table)."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.scoring.lengths import ModeError

_COLUMNS = (
    ("sweep", "sweep", "{}"),
    ("part", "part", "{}"),
    ("mode", "mode", "{}"),
    ("reference", "reference", "{}"),
    ("reference_mm", "reference mm", "{:.2f}"),
    ("estimate_mm", "estimate mm", "{:.2f}"),
    ("length_error_mm", "error mm", "{:+.2f}"),
    ("length_error_percent", "error %", "{:+.1f}"),
    ("tilt_error_deg", "tilt deg", "{:+.2f}"),
    ("yaw_error_deg", "yaw deg", "{:+.2f}"),
    ("roll_error_deg", "roll deg", "{:+.2f}"),
    ("remark", "remark", "{}"),
)
_TO_THE_LEFT = ("sweep", "part", "mode", "reference", "remark")
_UNLIKE = (0.5, 2.0)
"""Travel of tracker over that of images beyond which it is no drift: a wrong unit is a factor of ten."""

_TRAVEL_MM = 1.0
"""Below, jitter may be more than travel."""


@dataclass(frozen=True)
class Summary:
    """What one sweep's comparison found.

    Attributes
    ----------
    reference : str
        What the modes were compared with: "truth" or "tracker".
    coverage : float
        Share of the frames that have a reference.
    rows : sequence of ModeError
    details : dict
        Anything else worth keeping, by name: dataclasses, numbers, strings, arrays.
    """

    sweep: str
    reference: str
    frames: int
    coverage: float
    rows: Sequence[ModeError]
    details: dict[str, Any] = field(default_factory=dict)


def remark_on(summary: Summary, row: ModeError) -> str:
    """What a reader of a row must know beside its numbers; empty for nothing."""
    words = []
    images = next((r for r in summary.rows if r.mode == "image" and r.part == row.part), None)
    fitted = any(each.mode == "pose" for each in summary.rows)
    if row.mode == "pose" and summary.reference == "tracker":
        words.append("fitted to this tracker")
    if row.mode == "pose" and images is not None:
        words.append(_unlike(row.estimate_mm, images.estimate_mm))
    elif row.mode == "image" and summary.reference == "tracker" and not fitted:
        words.append(_unlike(row.reference_mm, row.estimate_mm))
    return "; ".join(each for each in words if each)


def _unlike(tracker_mm: float, images_mm: float) -> str:
    if not (abs(images_mm) >= _TRAVEL_MM and math.isfinite(tracker_mm)):
        return ""
    share = abs(tracker_mm / images_mm)
    low, high = _UNLIKE
    return "" if low <= share <= high else f"tracker travels {share:.2g} of what the images do: its unit?"


def write_summary(directory: Path, summaries: Sequence[Summary]) -> list[Path]:
    """Write ``summary.json``, ``table.txt`` and ``table.csv``; each appears whole or not at all.

    Raises
    ------
    FileError
        If the directory cannot be written.
    """
    contents = {
        "summary.json": json_text(summaries),
        "table.txt": table_text(summaries),
        "table.csv": csv_text(summaries),
    }
    return [_write_whole(directory / name, text) for name, text in contents.items()]


def json_text(summaries: Sequence[Summary]) -> str:
    """Summaries as strict JSON: a value that is not finite becomes null."""
    return json.dumps({"sweeps": [plain(summary) for summary in summaries]}, indent=2, allow_nan=False) + "\n"


def csv_text(summaries: Sequence[Summary]) -> str:
    """One line per sweep, part and mode, with full precision, under the names of `ModeError`."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sweep", "reference", *(f.name for f in fields(ModeError)), "remark"])
    for summary in summaries:
        for row in summary.rows:
            held = asdict(row).values()
            writer.writerow([summary.sweep, summary.reference, *held, remark_on(summary, row)])
    return text.getvalue()


def table_text(summaries: Sequence[Summary]) -> str:
    """Aligned table for reading; angles and lengths are estimate minus reference."""
    lines = [[heading for _, heading, _ in _COLUMNS]]
    for summary in summaries:
        for row in summary.rows:
            values = {"sweep": summary.sweep, "reference": summary.reference, **asdict(row)}
            values["remark"] = remark_on(summary, row)
            lines.append([_cell(values[key], form) for key, _, form in _COLUMNS])
    if not any(line[-1] for line in lines[1:]):
        lines = [line[:-1] for line in lines]
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(_aligned(line, widths) for line in lines) + "\n"


def plain(value: Any) -> Any:
    """Turn dataclasses, arrays and NumPy scalars into what JSON knows."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    raise InvalidInputError(f"summary: expected dataclasses, numbers, strings or arrays, got {type(value)}")


def _cell(value: Any, form: str) -> str:
    return "-" if isinstance(value, float) and math.isnan(value) else form.format(value)


def _aligned(cells: Sequence[str], widths: Sequence[int]) -> str:
    words = [
        cell.ljust(width) if key in _TO_THE_LEFT else cell.rjust(width)
        for cell, width, (key, _, _) in zip(cells, widths, _COLUMNS, strict=False)
    ]
    return "  ".join(words).rstrip()


def _write_whole(path: Path, text: str) -> Path:
    make_folder(path.parent)
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8")
    return path
