from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import speckle
from hypothesis import given
from hypothesis import strategies as st

from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep
from speckle3d.matching.inplane import InPlaneMotion, InPlaneSettings, compose, inverse
from speckle3d.matching.intensity import IntensitySettings
from speckle3d.matching.matcher import FrameMatcher, MatchingSettings
from speckle3d.matching.patches import PatchSettings

motions = st.builds(InPlaneMotion, st.floats(-20, 20), st.floats(-20, 20), st.floats(-np.pi / 2, np.pi / 2))


def matrix(motion):
    c, s = np.cos(motion.roll_rad), np.sin(motion.roll_rad)
    return np.array([[c, -s, motion.x_mm], [s, c, motion.y_mm], [0, 0, 1]])


@given(motions, motions)
def test_two_steps_are_one_rigid_motion(first, then):
    np.testing.assert_allclose(matrix(compose(first, then)), matrix(first) @ matrix(then), atol=1e-9)


@given(motions)
def test_there_and_back_is_no_motion(motion):
    np.testing.assert_allclose(matrix(inverse(motion)), np.linalg.inv(matrix(motion)), atol=1e-9)
    np.testing.assert_allclose(matrix(compose(motion, inverse(motion))), np.eye(3), atol=1e-9)


def bmode_of(amplitudes, decibel=60.0):
    """A sweep of log-compressed 8-bit images."""
    levels = np.array([np.abs(a) ** 2 for a in amplitudes])
    grey = 255 * (1 + 10 * np.log10(np.maximum(levels / levels.max(), 1e-12)) / decibel)
    frames = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return Sweep(frames, speckle.GRID, BModeSettings(decibel), 0.04 * np.arange(len(frames)))


def rf_of(amplitudes, grid):
    """A sweep of RF at the depths of `grid`; amplitudes are those of echoes about the centre frequency."""
    depth = np.arange(grid.samples) * grid.sample_spacing_mm
    carrier = np.exp(4e-3j * np.pi * speckle.RF.centre_frequency_hz / speckle.RF.speed_of_sound_m_s * depth)
    frames = np.rint(2000 * np.real(np.array(amplitudes) * carrier)).astype(np.int16)
    return Sweep(frames, grid, speckle.RF, 0.04 * np.arange(len(frames)))


def matcher_of(sweep, equalise_mm=2.0, **matching):
    intensity = IntensitySettings(equalise_mm=equalise_mm)
    return FrameMatcher(sweep, intensity, PatchSettings(), InPlaneSettings(), MatchingSettings(**matching))


def prepared(matcher, sweep):
    return [matcher.prepare(matcher.echo(frame)) for frame in sweep.frames]


@pytest.fixture(scope="module")
def steps():
    rng = np.random.default_rng(0)
    field = speckle.Speckle(rng)
    places = [(0.0, 0.0, 0.0), (0.5, -0.3, 0.008), (1.1, -0.2, 0.012)]
    return bmode_of([field.seen(*place) for place in places]), [InPlaneMotion(*p) for p in places]


def test_motion_is_found_in_log_compressed_images_too(steps):
    sweep, places = steps
    matcher = matcher_of(sweep)
    ready = [matcher.prepare(matcher.echo(sweep.frames[i])) for i in range(3)]
    one, two = (matcher.match(a, b, matcher.search(a, b)) for a, b in pairwise(ready))
    both = matcher.match(ready[0], ready[2], compose(one.motion, two.motion))
    # Grey levels of 0.24 dB and a clipped bottom cost next to nothing.
    assert np.nanmedian(both.correlation) > 0.98
    for found, expected in ((both.motion, places[2]), (compose(one.motion, two.motion), places[2])):
        np.testing.assert_allclose(matrix(found), matrix(expected), atol=0.01)
    back = matcher.match(ready[2], ready[0], inverse(both.motion)).motion
    np.testing.assert_allclose(matrix(back), matrix(inverse(places[2])), atol=0.01)


def test_the_key_holds_what_curves_depend_on(steps):
    sweep, _ = steps
    patches, intensity = PatchSettings(width_mm=2.4, height_mm=2.5), IntensitySettings(equalise_mm=1.5)
    key = FrameMatcher(sweep, intensity, patches, InPlaneSettings()).key
    assert key.signal == sweep.signal
    assert (key.vector_pitch_mm, key.patch_width_mm, key.patch_height_mm, key.equalise_mm) == (
        0.3,
        2.4,
        2.5,
        1.5,
    )
    assert key.correlation_of == "intensity"
    assert (key.edge_fraction, key.probe) == (intensity.edge_fraction, "")
    named = FrameMatcher(replace(sweep, probe="L12-5"), intensity, patches, InPlaneSettings())
    assert named.key.probe == "L12-5"


# ---- echoes ----------------------------------------------------------------------------------------------

RF_GRID = ImageGrid(48, 1300, 0.3, speckle.RF.sample_spacing_mm)
ROLL_RAD, RHO = np.deg2rad(0.5), 0.7


@pytest.fixture(scope="module")
def rolled():
    """Two RF frames: the second moved, rolled, and its speckle 0.7 alike."""
    rng = np.random.default_rng(11)
    field, other = (speckle.Speckle(rng, grid=RF_GRID, margin_mm=2.0) for _ in range(2))
    motion = (0.4, -0.3, ROLL_RAD)
    x = np.arange(48)[:, None] * 0.3 - RF_GRID.centre_mm[0]
    y = np.arange(1300) * RF_GRID.sample_spacing_mm - RF_GRID.centre_mm[1]
    deeper = np.sin(ROLL_RAD) * x + np.cos(ROLL_RAD) * y + motion[1] - y
    phase = np.exp(4e-3j * np.pi * 7e6 / 1540 * deeper)
    second = speckle.decorrelated(field.seen(*motion) * phase, other.seen(), RHO)
    return rf_of([field.seen(), second], RF_GRID), InPlaneMotion(*motion)


@pytest.mark.parametrize("correlate", ["echo", "intensity"])
def test_rf_frames_are_matched_whichever_is_correlated(rolled, correlate):
    sweep, motion = rolled
    matcher = matcher_of(sweep, correlate=correlate)
    one, two = prepared(matcher, sweep)
    start = matcher.search(one, two)
    found = matcher.match(one, two, start)
    np.testing.assert_allclose(matrix(found.motion), matrix(motion), atol=0.012)
    # 44 patches of 45 cells: a standard error of 0.012 in intensity, 0.008 in echo. The band's edges leave a
    # little. Without the ramp undone, a third of a turn over a patch, 0.5 would be left.
    assert np.nanmean(found.correlation) == pytest.approx(RHO, abs=0.035)


def test_echoes_are_what_is_correlated_unless_told_otherwise(rolled):
    sweep, _ = rolled
    (one, two), plain = prepared(matcher_of(sweep), sweep), matcher_of(sweep, correlate="intensity")
    assert MatchingSettings().correlate == "echo"
    assert one.echo.shape == (2, *one.image.shape)
    assert one.echo.dtype == np.float32
    # Equalised alike: the echo's power is the image.
    np.testing.assert_allclose((one.echo**2).sum(axis=0), one.image, rtol=1e-4, atol=1e-6)
    assert all(frame.echo is None for frame in prepared(plain, sweep))
    default = FrameMatcher(sweep, IntensitySettings(), PatchSettings(), InPlaneSettings())
    start = InPlaneMotion(0.4, -0.3, ROLL_RAD)
    found, again = (matcher.match(one, two, start) for matcher in (default, matcher_of(sweep)))
    np.testing.assert_array_equal(found.correlation, again.correlation)


def test_equalising_turns_no_echo():
    """Local gain changes an echo's size and leaves its phase, also where there is next to no echo."""
    field = speckle.Speckle(np.random.default_rng(2), grid=RF_GRID, margin_mm=1.0).seen()
    field[:, 600:700] = 0.0
    sweep = rf_of([field], RF_GRID)
    matcher = matcher_of(sweep)
    echo = matcher.echo(sweep.frames[0])
    ready = matcher.prepare(echo)
    assert np.isfinite(ready.echo).all()
    turned = (ready.echo[0] + 1j * ready.echo[1]) * np.conj(echo.analytic)
    np.testing.assert_allclose(turned, np.abs(turned), atol=1e-4 * np.abs(turned).max())


def test_without_equalising_the_echo_is_the_analytic_signal(rolled):
    sweep, _ = rolled
    matcher = matcher_of(sweep, equalise_mm=0.0)
    echo = matcher.echo(sweep.frames[0])
    ready = matcher.prepare(echo)
    np.testing.assert_array_equal(ready.echo[0] + 1j * ready.echo[1], echo.analytic)


def test_grey_levels_are_correlated_as_intensity_whatever_is_asked(steps):
    sweep, _ = steps
    matcher = matcher_of(sweep, correlate="echo")
    echo = matcher.echo(sweep.frames[0])
    assert echo.analytic is None
    assert matcher.prepare(echo).echo is None
    assert not matcher.of_echo
    assert matcher.key.correlation_of == "intensity"


def test_curves_of_intensity_do_not_serve_echoes_nor_the_other_way_round(rolled):
    sweep, _ = rolled
    keys = [matcher_of(sweep, correlate=kind).key for kind in ("echo", "intensity")]
    assert [key.correlation_of for key in keys] == ["echo", "intensity"]
    for mine, theirs in (keys, keys[::-1]):
        expected = f"correlation_of is {mine.correlation_of} and {theirs.correlation_of}"
        with pytest.raises(MismatchError, match=expected):
            mine.require_same(theirs)
        mine.require_same(replace(theirs, correlation_of=mine.correlation_of))


@pytest.mark.parametrize("bad", [{"correlate": "amplitude"}, {"typo": 1}])
def test_matching_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        MatchingSettings(**bad)
