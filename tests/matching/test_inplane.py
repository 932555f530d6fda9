"""In-plane motion on speckle that is coarse laterally: 0.3 mm between vectors, 0.35 mm deviation."""

from copy import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import speckle

from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.matching.intensity import Echo, two_way_wavenumber
from speckle3d.matching.matcher import FrameMatcher, ImageSettings

GRID = speckle.GRID
SPECTRA = [speckle.gaussian, pytest.param(speckle.triangle, marks=pytest.mark.slow)]
WAVENUMBER_PER_MM = two_way_wavenumber(speckle.RF)


def matcher_of(equalise_mm=0.0, **inplane):
    frames = np.zeros((1, GRID.vectors, GRID.samples), np.uint8)
    sweep = Sweep(frames, GRID, BModeSettings(60.0), np.zeros(1))
    settings = ImageSettings(
        intensity={"equalise_mm": equalise_mm}, inplane=inplane, matching={"correlate": "echo"}
    )
    return FrameMatcher(sweep, settings)


MATCHER = matcher_of()
PATCHES = MATCHER.patches


@cache
def speckle_of(seed, spectrum):
    """Speckle, the same at rest, and unrelated speckle."""
    rng = np.random.default_rng(seed)
    common = speckle.Speckle(rng, spectrum)
    return common, common.image(), speckle.Speckle(rng, spectrum).image()


def pair(seed, motion=(0.0, 0.0, 0.0), rho=1.0, spectrum=speckle.gaussian, strain=0.0):
    """Two frames' demodulated echoes; the second moved, and its tissue pressed by `strain` about the top.

    What lies deeper in the tissue than in the image comes with so much more phase.
    """
    common, first, independent = speckle_of(seed, spectrum)
    probe = copy(common)
    probe.grid = replace(GRID, sample_spacing_mm=GRID.sample_spacing_mm * (1 + strain))
    x_mm, y_mm, roll_rad = motion
    across = np.arange(GRID.vectors)[:, None] * GRID.vector_pitch_mm - GRID.centre_mm[0]
    steps = np.arange(GRID.samples) * probe.grid.sample_spacing_mm
    down = steps + GRID.first_sample_depth_mm - probe.grid.centre_mm[1]
    tissue_mm = np.sin(roll_rad) * across + np.cos(roll_rad) * down + y_mm + probe.grid.centre_mm[1]
    image_mm = np.arange(GRID.samples) * GRID.sample_spacing_mm + GRID.first_sample_depth_mm
    second = speckle.mix(probe.image(x_mm, y_mm, roll_rad), independent, rho)
    return first, second * np.exp(1j * WAVENUMBER_PER_MM * (tissue_mm - image_mm))


def prepare(echo, matcher=MATCHER, of_echo=False):
    frame = matcher.prepare(Echo(speckle.intensity(echo), None), PATCHES.inside, PATCHES.region)
    parts = np.stack([echo.real, echo.imag]).astype(np.float32)
    return frame._replace(echo=parts) if of_echo else frame


def match(echoes, start=None, of_echo=False, wavenumber_per_mm=WAVENUMBER_PER_MM):
    """In-plane motion, its covariance, and the patches' correlations."""
    fixed, moving = (prepare(echo, of_echo=of_echo) for echo in echoes)
    begin = MATCHER.search(fixed, moving) if start is None else np.array(start)
    MATCHER._wavenumber = wavenumber_per_mm
    table = MATCHER.match({0: fixed}, 1, moving, [begin])
    return table.inplane[0], table.inplane_covariance[0], table.correlation[0]


def motions(n, largest_roll_deg, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (n, 3)) * [1.2, 1.2, np.deg2rad(largest_roll_deg)]


# ---- motion ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize(
    # The peak of a patch of N = 80 cells is placed to sigma sqrt((1 - rho^2) / (N rho^2)), and 56 patches to
    # an eighth of that: 0.007 mm laterally and 0.002 mm axially at rho 0.6, 0.017 and 0.006 at 0.3. Roll is
    # the axial error over a lever of 7 mm rms. Twice that, thrice where the logarithm of small coefficients
    # gives out; at rho 1 it is interpolation alone: a hundredth of a vector's pitch.
    ("rho", "lateral_mm", "axial_mm", "roll_deg"),
    [(1.0, 0.003, 0.002, 0.01), (0.6, 0.015, 0.005, 0.04), (0.3, 0.045, 0.015, 0.12)],
)
def test_sub_sample_shift_and_roll_are_found_from_a_whole_frame_search(
    spectrum, rho, lateral_mm, axial_mm, roll_deg
):
    off = []
    for seed, motion in enumerate(motions(10, largest_roll_deg=0.6)):
        estimate, _, _ = match(pair(seed, motion, rho, spectrum))
        off.append((estimate - motion) * [1, 1, np.rad2deg(1)])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert (rms < [lateral_mm, axial_mm, roll_deg]).all(), rms


def test_covariance_is_of_the_errors_size():
    """Within a factor of 2.5 for speckle that correlates well; one would be exact."""
    pulls = []
    for seed, motion in enumerate(motions(12, 0.3, seed=1)):
        estimate, covariance, _ = match(pair(seed, motion, 0.7), motion)
        pulls.append((estimate - motion) / np.sqrt(np.diag(covariance)))
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (rms > 0.4).all(), rms
    assert (rms < 2.5).all(), rms


def test_patches_that_left_the_image_or_are_masked_are_nan_and_the_others_are_not():
    motion = (2.4, 0.0, 0.0)
    fixed, moving = (prepare(echo) for echo in pair(4, motion))
    outside = PATCHES.centre_mm[:, 0] < PATCHES.centre_mm[:, 0].min() + 0.1
    outside[[20, 30]] = fixed.usable[20] = moving.usable[30] = False
    outside[[20, 30]] = True
    (correlation,) = MATCHER.match({0: fixed}, 1, moving, [np.array(motion)]).correlation
    assert np.isnan(correlation[outside]).all()
    assert (correlation[~outside] > 0.95).all()


# ---- correlation at the motion ---------------------------------------------------------------------------


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("of_echo", [False, True])
@pytest.mark.parametrize("rho", [0.9, 0.5, 0.25])
def test_correlation_left_is_the_elevational_one_whatever_the_in_plane_motion(spectrum, rho, of_echo):
    """A half-degree's roll turns an echo's phase by a third of a cycle over a patch: it is undone."""
    means = []
    for seed, motion in enumerate(motions(6, 0.5, seed=2)):
        moving = np.nanmean(match(pair(seed, motion, rho, spectrum), motion, of_echo)[2])
        still = np.nanmean(match(pair(seed, (0, 0, 0), rho, spectrum), (0, 0, 0), of_echo)[2])
        means.append((moving, still))
    moving, still = np.mean(means, axis=0)
    # 56 patches of 80 cells, six times: a standard error of 0.005 at most. The rest is interpolation. The
    # squared coherence of N = 45 cells is (1 - rho)^2 / N high by nature.
    assert abs(still - of_echo * (1 - rho) ** 2 / 45 - rho) < 0.025
    assert abs(moving - still) < 0.015


@pytest.mark.parametrize(("roll_deg", "strain"), [(0.5, 0.0), (0.0, -0.005), (0.4, 0.004)])
def test_the_ramp_undoes_what_roll_and_axial_strain_do_to_the_echo(roll_deg, strain):
    motion = (0.1, 0.2, np.deg2rad(roll_deg))
    start, means = (0.1, 0.2 + strain * GRID.depth_mm / 2, motion[2]), []
    for sign in (1, 0, -1):
        wavenumber = sign * WAVENUMBER_PER_MM
        pairs = (pair(k, motion, 0.8, strain=strain) for k in range(4))
        means.append(np.nanmean([match(echoes, start, True, wavenumber)[2] for echoes in pairs]))
    # Over a patch of 3.6 x 3.0 mm the phase turns evenly by 57/mm slope side; sinc^2 of half that is left.
    turns = WAVENUMBER_PER_MM * np.array([np.deg2rad(roll_deg) * 3.6, strain * 3.0]) / (2 * np.pi)
    assert means[0] == pytest.approx(0.8, abs=0.015)
    assert means[1] == pytest.approx(0.8 * np.prod(np.sinc(turns) ** 2), abs=0.025)
    assert means[2] < means[1] - 0.1


def test_a_shadow_edge_is_no_pattern_that_stays():
    """Unrelated speckle has nothing in common where a third of each other column of patches is in shadow."""
    matcher = matcher_of(equalise_mm=2.0)
    first = matcher.patches.first[:, 0]
    wide = int(matcher.patches.size[0])

    def frame(seed):
        level_db = 10 * np.log10(speckle.intensity(speckle_of(seed, speckle.gaussian)[1])) - 20.0
        for vector in np.unique(first)[::2]:
            level_db[vector + wide // 3 : vector + 2 * wide // 3] -= 50.0
        return matcher.ready(np.rint(255 * np.clip(1 + level_db / 60, 0, 1)).astype(np.uint8)).frame

    (correlation,) = matcher.match({0: frame(1)}, 1, frame(2), [np.zeros(3)]).correlation
    shadowed = correlation[np.isin(first, np.unique(first)[::2])]
    # Twenty cells scatter by 0.2; the edges alone would be 0.25 to 0.35.
    assert abs(np.mean(shadowed)) < 0.12
    assert np.isfinite(shadowed).all()
