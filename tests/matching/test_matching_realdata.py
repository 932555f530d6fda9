"""Real RF through the stages up to correlation, without special cases."""

from itertools import pairwise

import numpy as np
import pytest

from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.matching.matcher import FrameMatcher

pytestmark = pytest.mark.realdata

# Centre and band are read off the spectra; the machine's own settings are not in the file.
MOUSE = ImportSettings(centre_frequency_hz=20e6, bandwidth_hz=(12e6, 28e6), frame_rate_hz=10.0)


def match(matcher, fixed, moving, start=None):
    begin = matcher.search(fixed, moving) if start is None else start
    table = matcher.match({0: fixed}, 1, moving, [begin])
    return table.inplane[0], table.correlation[0]


def test_neighbouring_frames_are_matched(realdata):
    sweep = load_sweep(realdata / "rf" / "MouseLiverRF.mha", MOUSE)
    matcher = FrameMatcher(sweep)
    frames = [matcher.ready(sweep.frames[i]).frame for i in range(len(sweep))]
    for fixed, moving in pairwise(frames):
        motion, correlation = match(matcher, fixed, moving)
        finite = np.isfinite(correlation)
        assert finite.mean() > 0.7
        # The mouse's frames lie close together: they share speckle, and moved little within the plane. Echoes
        # of breathing tissue share less than their intensity does, yet ten times what unrelated ones do.
        elsewhere = match(matcher, fixed, moving, np.array([0.0, 1.5, 0.0]))[1]
        assert np.median(correlation[finite]) > max(0.08, 10 * np.nanmedian(elsewhere))
        assert np.hypot(*motion[:2]) < 0.5
