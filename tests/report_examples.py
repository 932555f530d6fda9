"""A small study in a folder: a sweep that is there, one whose file is gone, and one that failed.

The second sweep and the reason of the third are what a careless page would take for HTML.
"""

import shutil
from dataclasses import replace

from speckle3d.config import Config
from speckle3d.core.errors import Doubt
from speckle3d.io.family.curves import read_curves
from speckle3d.io.hdf5 import sha256_of
from speckle3d.io.load import load_sweep
from speckle3d.study.job import run_job
from speckle3d.study.results import Study, SweepOutcome

MODES = ["image", "orientation", "pose", "tracker"]
REASON = "torn.h5: /rf: expected <three> axes & more, got \x1b[31mnone\u202e"
HOSTILE = "<script>alert('gone')</script>"
MEAN = {"mode": "pose", "quantity": "length_error_percent", "sweeps": 2, "mean": 0.987} | {
    "low": 0.5,
    "high": 1.5,
}
PAIR = {
    "mode": "image", "against": "pose", "quantity": "FDR_percent", "sweeps": 2, "difference": 11.1,
    "low": 2.1, "high": 20.0, "wilcoxon_p": 0.01, "holm_p": 0.03, "better": "pose",
}  # fmt: skip
"""What no two sweeps give."""


def small_study(folder, sweeps):
    """Make the study in a folder."""
    source = folder / "forward.h5"
    shutil.copy(sweeps / "s5.h5", source)
    curves = read_curves(sweeps / "curves.h5")
    job = run_job(load_sweep(source), source, curves, folder / "sweeps" / "forward-0a", MODES[1:3])
    shutil.copytree(folder / "sweeps" / "forward-0a", folder / "sweeps" / "gone-0b")
    doubt = Doubt("tracker", "units <in> metres", "expected 3 mm, got 0.003", True)
    drift = [{"mode": "image", "FDR_percent": 12.34, "GPE_mm": 0.5, "EA_deg": None}]
    summary = replace(job.summary, sweep="forward", drift=drift, doubts=[doubt])
    sha256 = sha256_of(source)
    study = Study(
        folder,
        [
            SweepOutcome("forward", source, "", sha256, "0a", "sweeps/forward-0a", summary=summary),
            SweepOutcome(HOSTILE, folder / "gone.h5", "", sha256, "0b", "sweeps/gone-0b",
                         summary=replace(job.summary, sweep=HOSTILE, drift=(), doubts=())),
            SweepOutcome("torn", folder / "torn.h5", REASON),
        ],
        Config().to_toml(),
    )  # fmt: skip
    vars(study)["statistics"] = [MEAN], [PAIR]
    return study
