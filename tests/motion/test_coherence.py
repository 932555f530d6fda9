"""Shares of structure, noise and the scale of distances, from echoes made sample by sample."""

from dataclasses import replace

import numpy as np
import pytest
import speckle
from pair_planes import problem_of, table_of

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.grid import ImageGrid
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.coherence import estimate_coherence

GRID = ImageGrid(vectors=48, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID)
SAMPLES = 80
CELLS = {"echo": float(SAMPLES), "intensity": 50.0}
"""Samples are independent; intensity's tails are heavier than the rule for its cells allows for."""
WIDTH_MM = 0.55
STRUCTURE_MM = 12.0


def field_correlation(distance_mm):
    """Amplitude correlation of the moving echo; heavy-tailed, as neither beam nor estimator assumes."""
    return 1.0 / (1.0 + (distance_mm / WIDTH_MM) ** 2)


def structure_correlation(distance_mm):
    """Of what stays: flat at first and gone in the end, unlike the estimator's exponential."""
    return np.exp(-((distance_mm / STRUCTURE_MM) ** 2))


def phantom_curves(correlate):
    """What a phantom calibrates to: few samples bias its correlations as they do a sweep's."""
    distance = np.linspace(0, 4.0, 401)
    row = np.clip(field_correlation(distance) ** 2, 1e-6, 1.0)
    if correlate == "echo":
        row = row + (1 - row) ** 2 / SAMPLES
    key = replace(speckle.KEY, correlation_of=correlate)
    cells = np.full(2, CELLS[correlate])
    return DecorrelationCurves(key, np.array([0.0, 40.0]), distance, np.tile(row, (2, 1)), cells)


def draws(rng, apart, correlation):
    """Complex Gaussian samples of every frame, frames `apart` mm from each other."""
    root = np.linalg.cholesky(correlation(apart) + 1e-9 * np.eye(len(apart)))
    return root @ (rng.normal(size=(len(apart), SAMPLES)) + 1j * rng.normal(size=(len(apart), SAMPLES)))


def correlations(echo, first, second, correlate):
    if correlate == "echo":
        cross = np.abs((echo[first].conj() * echo[second]).sum(axis=1)) ** 2
        power = (np.abs(echo) ** 2).sum(axis=1)
        return cross / (power[first] * power[second])
    intensity = np.abs(echo) ** 2
    intensity = (intensity - intensity.mean(axis=1, keepdims=True)) / intensity.std(axis=1, keepdims=True)
    return (intensity[first] * intensity[second]).mean(axis=1)


def sweep_table(path, share, noise, correlate, seed=0, steps=(1, 2, 3, 4, 6, 9, 12)):
    """Correlations of echoes drawn at every frame and patch; a table of pairs."""
    rng = np.random.default_rng(seed)
    first, second = np.array([(j - k, j) for j in range(len(path)) for k in steps if j >= k]).T
    apart, rho = np.abs(path[:, None] - path), []
    for p in range(len(PATCHES)):
        moving = draws(rng, apart, field_correlation)
        staying = draws(rng, apart, structure_correlation)
        grain = draws(rng, apart, lambda d: 1.0 * (d == 0))
        echo = np.sqrt(share[p]) * staying + np.sqrt(1 - share[p]) * moving + np.sqrt(noise[p]) * grain
        rho.append(correlations(echo, first, second, correlate))
    return table_of(np.array(rho).T, first=first, second=second)


def coherence_of(path, table, correlate="echo"):
    problem = problem_of(phantom_curves(correlate), PATCHES, GRID, len(path))
    return estimate_coherence(problem, table, np.outer(path, [1.0, 0.0, 0.0]))


def made_path(frames=90):
    """Uneven steps."""
    return np.cumsum(np.r_[0.0, np.random.default_rng(9).uniform(0.05, 0.2, frames - 1)])


def estimate(share=0.0, noise=0.0, start=1.0, seed=0, correlate="echo"):
    """Coherence, and length over the true length, where the path given is `start` times the true one."""
    path = made_path()
    share, noise = (np.broadcast_to(values, len(PATCHES)) for values in (share, noise))
    table = sweep_table(path, share, noise, correlate, seed)
    coherence = coherence_of(start * path, table, correlate)
    return coherence, start * coherence.scale


def choice(values, seed=1):
    return np.random.default_rng(seed).choice(values, len(PATCHES))


@pytest.mark.parametrize("start", [0.55, 1.0, 1.3])
def test_phantom_speckle_keeps_its_length_whatever_the_start(start):
    coherence, ratio = estimate(start=start)
    assert ratio == pytest.approx(1.0, abs=0.01)
    assert coherence.share.mean() < 0.01


def test_intensity_claims_what_its_missing_phase_leaves_open():
    coherence, ratio = estimate(choice([0.0, 0.3]), start=0.7, correlate="intensity")
    assert abs(np.log(ratio)) < 2.5 * coherence.scale_sigma  # Measured: 2.0.
    assert coherence.scale_sigma < 0.12


@pytest.mark.parametrize("share", [0.15, 0.3])
def test_structure_in_half_of_the_patches_does_not_shorten_the_sweep(share):
    shares = choice([0.0, share])
    coherence, ratio = estimate(shares, start=0.7)
    # A phantom's curve alone reads 12 and 25 % short.
    assert ratio == pytest.approx(1.0, abs=0.03)
    assert coherence.share[0, shares > 0].mean() > 0.4 * share
    assert coherence.share[0, shares == 0].mean() < 0.25 * share


def test_noise_is_a_gain_and_no_distance():
    coherence, ratio = estimate(noise=0.1)
    assert ratio == pytest.approx(1.0, abs=0.015)
    assert coherence.gain.mean() == pytest.approx(1.1**-2, abs=0.01)


def test_claims_of_the_scale_hold():
    off = []
    for seed in range(8):
        coherence, ratio = estimate(choice([0.0, 0.1, 0.25], seed), seed=seed)
        off.append(np.log(ratio) / coherence.scale_sigma)
    assert np.abs(off).max() < 3.0
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_long_sweep_is_fitted_in_pieces():
    path = np.linspace(0.0, 25.0, 251)
    table = sweep_table(path, choice([0.0, 0.3]), np.zeros(len(PATCHES)), "echo", steps=(1, 2, 4, 8))
    coherence = coherence_of(path, table)
    assert coherence.frame.size == len(coherence.share) == 2
    models = coherence.models(np.array([0, 250]))
    np.testing.assert_array_equal(models.share, coherence.share)
    np.testing.assert_array_equal(models.gain, coherence.gain)
    assert coherence.scale == pytest.approx(1.0, abs=0.02)


def test_two_frames_keep_the_phantoms_curves_and_claim_what_tissue_may_do():
    path = made_path(2)
    table = sweep_table(path, choice([0.0, 0.3]), np.zeros(len(PATCHES)), "echo", steps=(1,))
    coherence = coherence_of(path, table)
    assert coherence.scale == 1.0
    assert coherence.rows is None
    assert 0.1 < coherence.scale_sigma < 0.2
