"""Real RF through the stages up to correlation, without special cases."""

from itertools import pairwise

import numpy as np
import pytest

from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.matching.matcher import FrameMatcher

pytestmark = pytest.mark.realdata

# Centre and band are read off the spectra; the machines' own settings are not in the files.
MOUSE = ImportSettings(centre_frequency_hz=20e6, bandwidth_hz=(12e6, 28e6), frame_rate_hz=10.0)
ULTRASONIX = ImportSettings(
    sampling_rate_hz=40e6,
    vector_pitch_mm=0.3,
    centre_frequency_hz=5e6,
    bandwidth_hz=(3e6, 7e6),
    demodulation_frequency_hz=0.0,
)
RECORDINGS = {
    "mouse": ("rf/MouseLiverRF.mha", MOUSE),
    "ultrasonix": ("plus/UltrasonixLinearRfData.igs.mha", ULTRASONIX),
}


@pytest.fixture(scope="module", params=RECORDINGS)
def recording(request, realdata):
    path, settings = RECORDINGS[request.param]
    sweep = load_sweep(realdata / path, settings)
    return sweep, FrameMatcher(sweep)


def ready(matcher, frame):
    return matcher.prepare(matcher.echo(frame))


def match(matcher, fixed, moving, start=None):
    begin = matcher.search(fixed, moving) if start is None else start
    table = matcher.match({0: fixed}, 1, moving, [begin])
    return table.inplane[0], table.correlation[0]


def test_neighbouring_frames_are_matched(recording):
    sweep, matcher = recording
    frames = [ready(matcher, sweep.frames[i]) for i in range(len(sweep))]
    for fixed, moving in pairwise(frames):
        motion, correlation = match(matcher, fixed, moving)
        finite = np.isfinite(correlation)
        assert finite.mean() > 0.7
        # The mouse's frames lie close together: they share speckle, and moved little within the plane. Echoes
        # of breathing tissue share less than their intensity does, yet ten times what unrelated ones do.
        elsewhere = match(matcher, fixed, moving, np.array([0.0, 1.5, 0.0]))[1]
        assert np.median(correlation[finite]) > max(0.08, 10 * np.nanmedian(elsewhere))
        assert np.hypot(*motion[:2]) < 0.5
