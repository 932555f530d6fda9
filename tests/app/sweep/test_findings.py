from dataclasses import replace

import numpy as np
import pytest

from speckle3d.app.sweep.findings import FrameFindings
from speckle3d.config import Config
from speckle3d.matching.quality import FrameFlag


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
    flagged = {k: FrameFlag(int(flag)) for k, flag in enumerate(findings.flags) if flag}
    assert flagged == {
        3: FrameFlag.FROZEN, 5: FrameFlag.LIFTED, 6: FrameFlag.LIFTED, 8: FrameFlag.SATURATED,
    }  # fmt: skip
    assert findings.reasons(0) == []
    (frozen,), (lifted,), (saturated,) = (findings.reasons(k) for k in (3, 5, 8))
    assert "frame 2" in frozen
    assert "0 % of its patches hold speckle, expected at least 15 %" in lifted
    clipped = 100 * float((np.abs(spoilt.frames[8]) == np.abs(spoilt.frames[8]).max()).mean())
    assert f"{clipped:.2g} %" in saturated
