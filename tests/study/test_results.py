import csv
import io
import json
from dataclasses import dataclass

import numpy as np
import pytest

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.results import (
    Summary,
    csv_text,
    json_text,
    remark_on,
    rows_of,
    table_text,
    write_summary,
)


@dataclass(frozen=True)
class Extra:
    spread: np.ndarray
    best: float


def row(mode="image", **changes):
    values = {
        "part": "f", "mode": mode, "frames": 100, "reference_mm": 20.0, "estimate_mm": 23.0,
        "length_error_mm": 3.0, "length_error_percent": 15.0, "tilt_error_deg": -1.254,
        "yaw_error_deg": 0.1, "roll_error_deg": 0.0,
    }  # fmt: skip
    return ModeError(**{**values, **changes})


def summaries():
    details = {"extra": Extra(np.array([1.0, np.nan]), np.float64(2.5)), "note": "ok"}
    return [Summary("beef, 1", "tracker", 100, 0.95, [row(), row("orientation")], details)]


def test_json_holds_every_number_and_null_where_there_is_none():
    (found,) = json.loads(json_text({"sweeps": summaries()}))["sweeps"]
    assert found["rows"][1]["mode"] == "orientation"
    assert found["rows"][0]["tilt_error_deg"] == -1.254
    assert found["details"] == {"extra": {"spread": [1.0, None], "best": 2.5}, "note": "ok"}
    assert found["coverage"] == 0.95


def test_csv_reads_back_at_full_precision_even_with_commas_in_names():
    lines = list(csv.DictReader(io.StringIO(csv_text(rows_of(summaries())))))
    assert [line["mode"] for line in lines] == ["image", "orientation"]
    assert lines[0]["sweep"] == "beef, 1"
    assert float(lines[0]["tilt_error_deg"]) == -1.254


def test_table_is_aligned_and_signed_says_the_reference_and_a_name_may_end_in_nan():
    banan = Summary("banan", "truth", 100, 1.0, [row(tilt_error_deg=float("nan"))])
    lines = table_text(rows_of([*summaries(), banan])).splitlines()
    assert lines[0].split()[:3] == ["sweep", "part", "mode"]
    assert len({len(line) for line in lines[1:]}) == 1
    assert "+15.0" in lines[2]
    assert "-1.25" in lines[2]
    assert lines[-1].split()[:5] == ["banan", "f", "image", "truth", "20.00"]
    assert lines[-1].split()[-3] == "-"


UNIT = "tracker travels 0.1 of what the images do: its unit?"


@pytest.mark.parametrize(
    ("reference", "mode", "travel_mm", "words"),
    [
        ("tracker", "pose", 20.0, "fitted to this tracker"),
        ("truth", "pose", 20.0, ""),
        # A tracker in centimetres, read as millimetres.
        ("truth", "pose", 2.3, UNIT),
        ("tracker", "pose", 2.3, f"fitted to this tracker; {UNIT}"),
        ("tracker", "orientation", 23.0, ""),
    ],
)  # fmt: skip
def test_a_row_says_what_its_numbers_do_not(reference, mode, travel_mm, words):
    rows = [row(), row(mode, estimate_mm=travel_mm)]
    summary = Summary("s", reference, 100, 1.0, rows)
    assert remark_on(summary, rows[1]) == words
    assert (words in table_text(rows_of([summary])).splitlines()[3]) is True
    (line,) = [x for x in csv.DictReader(io.StringIO(csv_text(rows_of([summary])))) if x["mode"] == mode]
    assert line["remark"] == words


def test_without_a_pose_mode_the_tracker_is_held_against_the_images():
    rows = [row(reference_mm=230.0, estimate_mm=23.0)]
    assert remark_on(Summary("s", "tracker", 9, 1.0, rows), rows[0]).startswith("tracker travels 10 of what")
    # A probe at rest: jitter against jitter tells nothing of units.
    still = [row(reference_mm=0.01, estimate_mm=0.3)]
    assert remark_on(Summary("s", "tracker", 9, 1.0, still), still[0]) == ""


def test_three_files_appear_and_nothing_else(tmp_path):
    written = write_summary(tmp_path / "new", *summaries())
    assert {p.name for p in written} == {"summary.json", "table.txt", "table.csv"}
    assert {p.name for p in (tmp_path / "new").iterdir()} == {p.name for p in written}
    assert json.loads(written[0].read_text())["sweeps"][0]["sweep"] == "beef, 1"


def test_a_directory_that_cannot_be_made_is_one_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        write_summary(tmp_path / "file", *summaries())


def test_what_json_cannot_hold_is_named():
    with pytest.raises(InvalidInputError, match="'object'"):
        json_text({"a": [object()]})
