"""Tables and JSON of one sweep and of a study."""

import json
from dataclasses import replace

from speckle3d.core.errors import Doubt
from speckle3d.core.reconstruction import Provenance
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.results import (
    Study,
    Summary,
    SweepOutcome,
    read_summary,
    recorded_doubts,
    write_study,
    write_summary,
)

METRES = Doubt("tracker", "units", "expected 23 mm, got 0.023", True)
SPIKES = Doubt("orientation sensor", "spikes", "3 of 90 readings jump", False, ((3, 3), (7, 9)))


def row(mode="image", **changes):
    values = {
        "part": "f", "mode": mode, "frames": 100, "reference_mm": 20.0, "estimate_mm": 23.0,
        "length_error_mm": 3.0, "length_error_percent": 15.0, "tilt_error_deg": -1.254,
        "yaw_error_deg": 0.1, "roll_error_deg": 0.0,
    }  # fmt: skip
    return ModeError(**{**values, **changes})


def summary(reference="tracker", rows=None, **fields):
    return Summary("beef, 1", reference, 100, 0.95, rows or [row(), row("orientation")], **fields)


def test_what_is_in_doubt_and_left_out_stands_below_the_table_and_is_read_back(tmp_path):
    left_out = {"pose": "s: drift mode pose: tracker: ..."}
    doubts, details = [METRES, SPIKES], {"provenance": Provenance("s.h5", "ab12", "1.0"), "seconds": 2.0}
    rows = [row(sigma_mm=1.0)]
    of = Summary("s", "truth", 9, 1.0, rows, details, doubts, left_out, {"image": 0.1})
    write_summary(tmp_path, of)
    provenance = Provenance("s.h5", "ab12", "1.0")
    assert recorded_doubts(tmp_path / "reconstruction.h5", provenance) == (METRES, SPIKES)
    assert recorded_doubts(tmp_path / "reconstruction.h5", replace(provenance, input_sha256="cd34")) is None
    assert "s: mode pose is left out" in (tmp_path / "table.txt").read_text()
    again = read_summary(tmp_path, "s")
    assert replace(again, drift=(), details=details) == of
    study = Study(tmp_path, [SweepOutcome("s", tmp_path, folder=".", summary=again)], "")
    write_study(study)
    doubts = json.loads((tmp_path / "study.json").read_text())["doubts"]
    assert [(doubt["sweep"], doubt["suspect"]) for doubt in doubts] == [("s", "units"), ("s", "spikes")]
    assert "mode pose is left out" in study.table
