from itertools import pairwise

import numpy as np
import pytest
import speckle
from hypothesis import given
from hypothesis import strategies as st

from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.motion.inplane import InPlaneMotion, InPlaneSettings
from speckle3d.motion.intensity import IntensitySettings
from speckle3d.motion.matching import FrameMatcher, compose, inverse
from speckle3d.motion.patches import PatchSettings

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


def matcher_of(sweep):
    return FrameMatcher(sweep, IntensitySettings(), PatchSettings(), InPlaneSettings())


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
