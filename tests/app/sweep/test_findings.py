from dataclasses import replace

import numpy as np
import pytest

from speckle3d.app.sweep.findings import FrameFindings
from speckle3d.config import Config


@pytest.fixture(scope="module")
def spoilt(sweep):
    """Frame 3 repeats frame 2, 5 and 6 are noise, 8 is clipped."""
    rng = np.random.default_rng(1)
    frames = np.stack([sweep.frames[k] for k in range(10)])
    frames[3] = frames[2]
    frames[5:7] = np.rint(rng.normal(0.0, 3.5, frames[5:7].shape))
    limit = np.percentile(np.abs(frames[8]), 90)
    frames[8] = np.clip(frames[8], -limit, limit)
    return replace(sweep.part(0, 10), frames=frames)


def test_without_a_reconstruction_frames_are_judged_here_and_say_why(spoilt):
    findings = FrameFindings(spoilt, Config(), None, None)
    while findings.flags is None:
        findings.judge_next()
    names = {k: reason.split(":")[0] for k in range(10) for reason in findings.reasons(k)}
    assert names == {3: "frozen", 5: "lifted", 6: "lifted", 8: "saturated"}
