"""A small study in a folder: a sweep that is there, one whose file is gone, and one that failed.

The second sweep and the reason of the third are what a careless page would take for HTML.
"""

import json
import shutil

from speckle3d.config import Config
from speckle3d.io.curves import read_curves
from speckle3d.io.hdf5 import sha256_of
from speckle3d.io.load import load_sweep
from speckle3d.study.job import run_job
from speckle3d.study.results import json_text

MODES = ["image", "orientation", "pose", "tracker"]
REASON = "torn.h5: /rf: expected <three> axes & more, got \x1b[31mnone\u202e"
HOSTILE = "<script>alert('gone')</script>"


def small_study(folder, sweeps):
    """Make the study in a folder; returns the folder."""
    source = folder / "forward.h5"
    shutil.copy(sweeps / "s5.h5", source)
    curves = read_curves(sweeps / "curves.h5")
    job = run_job(load_sweep(source), source, curves, folder / "sweeps" / "forward-0a", MODES[1:3])
    shutil.copytree(folder / "sweeps" / "forward-0a", folder / "sweeps" / "gone-0b")
    rows = [record | {"sweep": name} for name in ("forward", HOSTILE) for record in job.summary.records()]
    rows = json.loads(json_text(rows))
    done = {"sha256": sha256_of(source), "key": "0a", "status": "done", "reason": "", "seconds": 1.25}
    study = {
        "format": "speckle3d.study",
        "version": 2,
        "settings_toml": Config().to_toml(),
        "modes": MODES,
        "sweeps": [
            {"name": "forward", "path": str(source), "folder": "sweeps/forward-0a", **done},
            {"name": HOSTILE, "path": str(folder / "gone.h5"), "folder": "sweeps/gone-0b", **done},
            {"name": "torn", "path": "torn.h5", "sha256": "", "key": "", "status": "failed", "reason": REASON,
             "folder": "sweeps/torn-0c", "seconds": 0.1},
        ],
        "doubts": [{"sweep": "forward", "about": "tracker", "suspect": "units <in> metres",
                    "evidence": "expected 3 mm, got 0.003", "refuted": True}],
        "rows": rows,
        "drift": [
            {"sweep": "forward", "mode": "image", "FDR_percent": 12.34, "GPE_mm": 0.5, "EA_deg": None}],
        "intervals": [{"mode": "pose", "quantity": "length_error_percent", "sweeps": 2, "mean": 0.987,
                       "low": 0.5, "high": 1.5}],
        "paired": [{"mode": "image", "against": "pose", "quantity": "FDR_percent", "sweeps": 2,
                    "difference": 11.1, "low": 2.1, "high": 20.0, "wilcoxon_p": 0.01, "holm_p": 0.03,
                    "better": "pose"}],
    }  # fmt: skip
    (folder / "study.json").write_text(json.dumps(study), encoding="utf-8")
    return folder
