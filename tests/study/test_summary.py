import csv
import io
import json
from dataclasses import dataclass

import numpy as np
import pytest

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.study.metrics import ModeError
from speckle3d.study.summary import Summary, csv_text, json_text, plain, table_text, write_summary


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
    (found,) = json.loads(json_text(summaries()))["sweeps"]
    assert found["rows"][1]["mode"] == "orientation"
    assert found["rows"][0]["tilt_error_deg"] == -1.254
    assert found["details"] == {"extra": {"spread": [1.0, None], "best": 2.5}, "note": "ok"}
    assert found["coverage"] == 0.95


def test_csv_reads_back_at_full_precision_even_with_commas_in_names():
    lines = list(csv.DictReader(io.StringIO(csv_text(summaries()))))
    assert [line["mode"] for line in lines] == ["image", "orientation"]
    assert lines[0]["sweep"] == "beef, 1"
    assert float(lines[0]["tilt_error_deg"]) == -1.254


def test_table_is_aligned_and_signed():
    lines = table_text(summaries()).splitlines()
    assert lines[0].split()[:3] == ["sweep", "part", "mode"]
    assert len({len(line) for line in lines[1:]}) == 1
    assert "+15.0" in lines[2]
    assert "-1.25" in lines[2]


def test_three_files_appear_and_nothing_else(tmp_path):
    written = write_summary(tmp_path / "new", summaries())
    assert {p.name for p in written} == {"summary.json", "table.txt", "table.csv"}
    assert {p.name for p in (tmp_path / "new").iterdir()} == {p.name for p in written}
    assert json.loads(written[0].read_text())["sweeps"][0]["sweep"] == "beef, 1"


def test_a_directory_that_cannot_be_made_is_one_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be made a folder"):
        write_summary(tmp_path / "file", summaries())


def test_what_json_cannot_hold_is_named():
    with pytest.raises(InvalidInputError, match=r"got <class 'object'>"):
        plain({"a": [object()]})
