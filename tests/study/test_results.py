import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.reconstruction import Provenance
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.details import recorded_doubts
from speckle3d.study.results import (
    Summary,
    SweepOutcome,
    csv_text,
    json_text,
    remark_on,
    rows_of,
    table_text,
    write_study,
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


METRES = Doubt("tracker", "units", "expected 23 mm, got 0.023", True)
SPIKES = Doubt("orientation sensor", "spikes", "3 of 90 readings jump", False, ((3, 3), (7, 9)))


@pytest.mark.parametrize(
    ("reference", "mode", "doubted", "words"),
    [
        ("tracker", "pose", {}, "fitted to this tracker"),
        ("truth", "pose", {}, ""),
        ("truth", "orientation", {"orientation": "spikes"}, "in doubt: spikes"),
        ("tracker", "pose", {"pose": "clock"}, "fitted to this tracker; in doubt: clock"),
        ("tracker", "orientation", {"pose": "clock"}, ""),
    ],
)  # fmt: skip
def test_a_row_says_what_its_numbers_do_not(reference, mode, doubted, words):
    rows = [row(), row(mode)]
    summary = Summary("s", reference, 100, 1.0, rows, doubted=doubted)
    assert remark_on(summary, rows[1]) == words
    assert (words in table_text(rows_of([summary])).splitlines()[3]) is True
    (line,) = [x for x in csv.DictReader(io.StringIO(csv_text(rows_of([summary])))) if x["mode"] == mode]
    assert line["remark"] == words


def test_what_is_in_doubt_and_left_out_stands_below_the_table_and_is_read_back(tmp_path):
    left_out = {"pose": "s: drift mode pose: tracker: ..."}
    summary = Summary("s", "truth", 100, 1.0, [row()], {}, [METRES, SPIKES], {"image": "x"}, left_out)
    write_summary(tmp_path, summary)
    lines = (tmp_path / "table.txt").read_text().splitlines()[-3:]
    assert [line.split(":")[1].strip() for line in lines] == [
        "tracker",
        "orientation sensor",
        "mode pose is left out",
    ]
    assert "units" in lines[0]
    assert "refused" in lines[0]
    assert "refused" not in lines[1]
    (tmp_path / "drift.json").write_text("[]")
    outcome = SweepOutcome("s", tmp_path, "done", folder=".")
    study = write_study(tmp_path, [outcome], "")
    assert list(study.summaries[0].doubts) == [METRES, SPIKES]
    assert study.summaries[0].left_out == left_out
    held = json.loads((tmp_path / "study.json").read_text())["doubts"]
    assert [(each["sweep"], each["suspect"]) for each in held] == [("s", "units"), ("s", "spikes")]
    assert all(line in study.table for line in lines)


def test_doubts_are_found_again_beside_the_reconstruction_they_belong_to(tmp_path):
    made = Provenance("s.h5", "ab12", "1.0")
    path = tmp_path / "reconstruction.h5"
    assert recorded_doubts(path, made) is None
    write_summary(tmp_path, Summary("s", "none", 9, 0.0, [], {"provenance": made}, [METRES, SPIKES]))
    assert recorded_doubts(path, made) == (METRES, SPIKES)
    assert recorded_doubts(path, Provenance("s.h5", "cd34", "1.0")) is None
    (tmp_path / "summary.json").write_text("[1]")
    assert recorded_doubts(path, made) is None


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


def test_a_study_takes_the_place_of_the_one_before_with_all_that_was_made_from_it(tmp_path, monkeypatch):
    failed = [SweepOutcome("a", tmp_path / "a.h5", "failed", "first")]
    write_study(tmp_path, failed, "first")
    (tmp_path / "figures").mkdir()
    made = [tmp_path / "report.html", tmp_path / "figures" / "overview.png", tmp_path / "paper.txt"]
    for path in made:
        path.write_text("of the first")
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full_disk)
        with pytest.raises(FileError, match=r"study\.json: .*No space"):
            write_study(tmp_path, failed, "second")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == kept
    write_study(tmp_path, failed, "second")
    assert not any(path.exists() for path in made)
    assert json.loads((tmp_path / "study.json").read_text())["settings_toml"] == "second"


def full_disk(*_, **__):
    raise OSError(28, "No space left on device")
