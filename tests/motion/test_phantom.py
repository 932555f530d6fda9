"""From a phantom sweep with known positions to its decorrelation curve, on speckle whose curve is known."""

from dataclasses import replace

import numpy as np
import pytest
import speckle
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import BModeSettings, Sweep, Tracker
from speckle3d.matching.frames import match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.schedule import KnownSchedule
from speckle3d.motion.phantom import CurveSettings, fit_curves
from speckle3d.phantom_curves import known_positions, phantom_pairs, phantom_samples

SIGMA_MM, FRAMES = 0.3, 44
GRID = ImageGrid(48, 260, 0.3, 0.06)
SETTINGS = CurveSettings(largest_mm=1.2, pairs=400)


@pytest.fixture(scope="module")
def phantom():
    """Planes of independent speckle blended over elevation; the blend's width makes the curve's."""
    rng = np.random.default_rng(2)
    z = 0.08 * np.arange(FRAMES) * (1 + 0.3 * np.sin(np.arange(FRAMES) / 9))
    planes = np.arange(z.min() - 3 * SIGMA_MM, z.max() + 3 * SIGMA_MM, SIGMA_MM / 2)
    fields = np.array([speckle.Speckle(rng, grid=GRID, margin_mm=2.0).image() for _ in planes])
    blend = np.exp(-((z[:, None] - planes) ** 2) / (2 * SIGMA_MM**2))
    levels = np.abs(np.einsum("fp,pvs->fvs", blend, fields)) ** 2
    grey = 255 + 255 / 8 * np.log10(np.maximum(levels / levels.max(), 1e-8))
    poses = RigidTransform.from_translation(np.column_stack([0 * z, 0 * z, z]))
    place = RigidTransform.from_components([30.0, -80.0, 5.0], Rotation.from_rotvec([0.3, 1.0, -0.4]))
    time = 0.04 * np.arange(FRAMES)
    return Sweep(
        grey.astype(np.float32), GRID, BModeSettings(80.0), time, truth=place * poses, name="phantom"
    )


def samples_of(sweep, settings, progress=None):
    matcher, poses = FrameMatcher(sweep), known_positions(sweep)
    pairs = phantom_pairs(sweep, poses, settings)
    matches = match_sweep(sweep, matcher, KnownSchedule(pairs), progress)
    return phantom_samples(poses, matcher.patches, matches.table, pairs)


def test_the_curve_comes_back(phantom):
    progress = []
    samples = samples_of(phantom, SETTINGS, lambda n, of: progress.append((n, of)))
    curves = fit_curves(speckle.KEY, [samples], SETTINGS)
    assert progress == [(n + 1, FRAMES) for n in range(FRAMES)]
    d = curves.distance_mm
    widths = [np.interp(-0.6, -row, d) / np.sqrt(-2 * np.log(0.6)) for row in curves.correlation]
    # Some eight independent separations, four patches to a row: 4 % of the width in a row, 2 % in the mean.
    assert abs(np.mean(widths) / SIGMA_MM - 1) < 0.06
    assert np.abs(np.array(widths) / SIGMA_MM - 1).max() < 0.15


def frame_pair(phantom, step_mm, tilt):
    """The phantom's first two frames, the second moved and turned about the middle of its depth."""
    about = RigidTransform.from_translation(GRID.centre_mm)
    turn = about * RigidTransform.from_rotation(Rotation.from_rotvec([[0, 0, 0], [tilt, 0, 0]])) * about.inv()
    step = RigidTransform.from_translation([[0, 0, 0], [0, 0, step_mm]])
    return replace(
        phantom, frames=phantom.frames[:2], frame_time_s=phantom.frame_time_s[:2], truth=step * turn
    )


@pytest.mark.parametrize("step_mm", [0.3, -0.3, 0.0])
@pytest.mark.parametrize("tilt", [0.01, -0.01])
def test_offsets_and_tilt_are_signed_and_those_of_the_patches(phantom, step_mm, tilt):
    pair = frame_pair(phantom, step_mm, tilt)
    samples = samples_of(pair, SETTINGS)
    expected = step_mm + np.sin(tilt) * (samples.depth_mm - GRID.centre_mm[1])
    np.testing.assert_allclose(samples.offset_mm, expected, atol=1e-3)
    np.testing.assert_allclose(samples.tilt_rad, np.sin(tilt), atol=1e-9)


def test_frames_too_far_apart_or_without_positions_are_refused(phantom):
    z = 5.0 * np.arange(FRAMES)
    far = replace(phantom, truth=RigidTransform.from_translation(np.column_stack([0 * z, 0 * z, z])))
    with pytest.raises(InsufficientDataError, match=r"^phantom: .*1\.2 mm"):
        samples_of(far, SETTINGS)
    with pytest.raises(InsufficientDataError, match="/truth or /tracker"):
        known_positions(replace(phantom, truth=None))


def test_a_trackers_jitter_is_smoothed_away(phantom):
    rng = np.random.default_rng(4)
    jitter = RigidTransform.from_components(
        rng.normal(0, 0.05, (FRAMES, 3)), Rotation.from_rotvec(rng.normal(0, 2e-4, (FRAMES, 3)))
    )
    tracker = Tracker(TimedPoses(phantom.frame_time_s, phantom.truth * jitter), RigidTransform.identity())
    poses = known_positions(replace(phantom, truth=None, tracker=tracker))
    assert known_positions(replace(phantom, tracker=tracker)) is phantom.truth
    rough, smooth = (
        np.std((phantom.truth.inv() * p).translation[:, 2]) for p in (phantom.truth * jitter, poses)
    )
    # A curve of some five degrees of freedom through 44 samples: a third of the jitter.
    assert smooth < 0.5 * rough
