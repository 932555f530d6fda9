"""Real RF through the stages up to correlation, without special cases."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.matching.inplane import InPlaneMotion, InPlaneSettings
from speckle3d.matching.intensity import IntensitySettings
from speckle3d.matching.matcher import FrameMatcher, MatchingSettings
from speckle3d.matching.patches import PatchSettings

pytestmark = pytest.mark.realdata

# Centre and band are read off the spectra; the machines' own settings are not in the files.
MOUSE = ImportSettings(centre_frequency_hz=20e6, bandwidth_hz=(12e6, 28e6), frame_rate_hz=10.0)
MOUSE_ALSO = ImportSettings(centre_frequency_hz=18e6, bandwidth_hz=(14e6, 22e6), frame_rate_hz=10.0)
ULTRASONIX = ImportSettings(
    sampling_rate_hz=40e6,
    vector_pitch_mm=0.3,
    centre_frequency_hz=5e6,
    bandwidth_hz=(3e6, 7e6),
    demodulation_frequency_hz=0.0,
)
RECORDINGS = {
    "mouse": ("rf/MouseLiverRF.mha", MOUSE),
    "mouse, half the band": ("rf/MouseLiverRF.mha", MOUSE_ALSO),
    "ultrasonix": ("plus/UltrasonixLinearRfData.igs.mha", ULTRASONIX),
}


@pytest.fixture(scope="module", params=RECORDINGS)
def recording(request, realdata):
    path, settings = RECORDINGS[request.param]
    sweep = load_sweep(realdata / path, settings)
    return sweep, FrameMatcher(sweep, IntensitySettings(), PatchSettings(), InPlaneSettings())


def ready(matcher, frame):
    return matcher.prepare(matcher.echo(frame))


@pytest.mark.parametrize(("vectors", "steps"), [(0, 0), (2, 12), (-3, -16), (5, 32), (1, -40)])
def test_a_frame_and_its_shifted_copy_are_the_same_speckle(recording, vectors, steps):
    sweep, matcher = recording
    step = matcher.grid.sample_spacing_mm / sweep.grid.sample_spacing_mm
    # Four samples of intensity are nine of the ultrasonix's echoes.
    shift = (vectors, round(steps * step))
    frame = sweep.frames[0]
    fixed, moving = ready(matcher, frame), ready(matcher, np.roll(frame, shift, axis=(0, 1)))
    found = matcher.match(fixed, moving, matcher.search(fixed, moving))
    expected = -np.array(shift) * [sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm]
    # By whole samples of intensity there is nothing to interpolate: what is left is the ends of vectors.
    np.testing.assert_allclose([found.motion.x_mm, found.motion.y_mm], expected, atol=0.003)
    assert abs(np.rad2deg(found.motion.roll_rad)) < 0.02
    assert np.nanmedian(found.correlation) > 0.999
    assert np.isfinite(found.correlation).mean() > 0.7


def test_a_shift_between_samples_of_intensity_costs_little(recording):
    sweep, matcher = recording
    frame = sweep.frames[0]
    fixed = ready(matcher, frame)
    for samples in (1, 2, 20, 47):
        moving = ready(matcher, np.roll(frame, samples, axis=1))
        found = matcher.match(fixed, moving, matcher.search(fixed, moving))
        assert abs(found.motion.y_mm + samples * sweep.grid.sample_spacing_mm) < 0.006
        # Where neighbouring vectors have nothing in common the parabola goes through rho itself.
        assert 0.94 < np.nanmedian(found.correlation) < 1.05


def test_neighbouring_frames_are_matched(recording):
    sweep, matcher = recording
    frames = [ready(matcher, sweep.frames[i]) for i in range(len(sweep))]
    for fixed, moving in pairwise(frames):
        found = matcher.match(fixed, moving, matcher.search(fixed, moving))
        known = np.isfinite(found.correlation)
        assert known.mean() > 0.7
        assert (np.abs(found.correlation[known]) <= 1.1).all()
        # The mouse's frames lie close together: they share speckle, and moved little within the plane. Echoes
        # of breathing tissue share less than their intensity does, yet ten times what unrelated ones do.
        elsewhere = matcher.match(fixed, moving, InPlaneMotion(0.0, 1.5)).correlation
        assert np.median(found.correlation[known]) > max(0.08, 10 * np.nanmedian(elsewhere))
        assert np.hypot(found.motion.x_mm, found.motion.y_mm) < 0.5


def test_intensity_of_neighbouring_frames_is_matched_too(recording):
    sweep, _ = recording
    settings = MatchingSettings(correlate="intensity")
    matcher = FrameMatcher(sweep, IntensitySettings(), PatchSettings(), InPlaneSettings(), settings)
    frames = [ready(matcher, sweep.frames[i]) for i in range(len(sweep))]
    for fixed, moving in pairwise(frames):
        found = matcher.match(fixed, moving, matcher.search(fixed, moving))
        assert np.nanmedian(found.correlation) > 0.15


def test_other_samples_of_one_signal_make_the_same_intensity(recording):
    sweep, matcher = recording
    frame = sweep.frames[0]
    plain = matcher.echo(frame)
    doubled = matcher.echo(frame.astype(np.result_type(frame.dtype, np.float32)) * 2)
    top = plain.intensity.max()
    np.testing.assert_allclose(doubled.intensity, 4 * plain.intensity, rtol=1e-3, atol=1e-5 * top)
    np.testing.assert_allclose(doubled.analytic, 2 * plain.analytic, rtol=1e-3, atol=3e-3 * np.sqrt(top))
    once, twice = matcher.prepare(plain), matcher.prepare(doubled)
    for one, two in ((once.image, twice.image), (once.echo, twice.echo)):
        assert np.isfinite(one).all()
        np.testing.assert_allclose(two, one, atol=2e-3)
    longer = replace(sweep, name="again")
    assert matcher.key == FrameMatcher(longer, IntensitySettings(), PatchSettings(), InPlaneSettings()).key
