"""Coherent shares, noise and the scale of distances, from echoes made sample by sample."""

import numpy as np
import pytest
import speckle

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import ImageGrid
from speckle3d.kernels.coherence import fit_coherent_shares
from speckle3d.motion.coherence import CoherenceSettings, estimate_coherence
from speckle3d.motion.patches import PatchSettings, lay_patches

GRID = ImageGrid(vectors=48, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID, PatchSettings())
SAMPLES = 80
CELLS = 50.0
"""What the scatter about the curve says: intensity has heavier tails than the rule for cells allows for."""
WIDTH_MM = 0.55


def field_correlation(distance_mm):
    """Amplitude correlation of the moving echo; heavy-tailed, as neither beam nor estimator assumes."""
    return 1.0 / (1.0 + (distance_mm / WIDTH_MM) ** 2)


def phantom_curves():
    distance = np.linspace(0, 4.0, 401)
    depth = np.array([0.0, 40.0])
    row = np.clip(field_correlation(distance) ** 2, 1e-6, 1.0)
    return DecorrelationCurves(speckle.KEY, depth, distance, np.tile(row, (2, 1)), np.full(2, CELLS))


def sweep_table(position_mm, share, noise, seed=0, steps=(1, 2, 3, 4, 6, 9, 12)):
    """Correlations of the intensity of echoes drawn at every frame; a table of pairs."""
    rng = np.random.default_rng(seed)
    frames = len(position_mm)
    apart = np.abs(position_mm[:, None] - position_mm)
    root = np.linalg.cholesky(field_correlation(apart) + 1e-9 * np.eye(frames))
    rho, pairs = [], [(j - k, j) for j in range(frames) for k in steps if j >= k]
    first, second = np.array(pairs).T
    for c, power in zip(share, noise, strict=True):
        draw = rng.normal(size=(2, frames, SAMPLES))
        moving = root @ (draw[0] + 1j * draw[1])
        staying = rng.normal(size=SAMPLES) + 1j * rng.normal(size=SAMPLES)
        grain = rng.normal(size=(frames, SAMPLES)) + 1j * rng.normal(size=(frames, SAMPLES))
        echo = np.sqrt(c) * staying + np.sqrt(1 - c) * moving + np.sqrt(power) * grain
        seen = np.abs(echo) ** 2
        seen = (seen - seen.mean(axis=1, keepdims=True)) / seen.std(axis=1, keepdims=True)
        rho.append((seen[first] * seen[second]).mean(axis=1))
    return first, second, np.array(rho, dtype=np.float32).T


def estimate(share, noise=0.0, start=1.0, seed=0, **settings):
    position = np.cumsum(np.r_[0.0, np.random.default_rng(9).uniform(0.05, 0.2, 89)])
    shares = np.broadcast_to(share, len(PATCHES))
    table = sweep_table(position, shares, np.broadcast_to(noise, len(PATCHES)), seed)
    found, rescaled = estimate_coherence(
        *table, start * position, phantom_curves(), PATCHES, CoherenceSettings(**settings)
    )
    return found, rescaled[-1] / position[-1]


@pytest.mark.parametrize("start", [0.55, 1.0, 1.3])
def test_phantom_speckle_keeps_its_length_whatever_the_start(start):
    found, ratio = estimate(0.0, start=start)
    # Correlations of 80 samples come out 1 to 2 % low, here uncalibrated; 1 % is for chance shares.
    assert ratio == pytest.approx(1.0, abs=0.045)
    assert (found.share == 0).mean() > 0.8


@pytest.mark.parametrize("start", [0.55, 1.0])
def test_length_is_found_where_much_of_the_echo_stays(start):
    share = np.random.default_rng(1).choice([0.0, 0.15, 0.4, 0.7], len(PATCHES))
    found, ratio = estimate(share, start=start)
    # A reading by the phantom's curve is a third and more too short here; a tenth of that may stay.
    assert ratio == pytest.approx(1.0, abs=0.03)
    for c in (0.4, 0.7):
        assert found.share[:, share == c].mean() == pytest.approx(c, abs=0.12)


def test_noise_is_not_read_as_motion():
    noise = np.where(PATCHES.centre_mm[:, 1] > 30, 0.25, 0.0)
    found, ratio = estimate(0.0, noise)
    assert ratio == pytest.approx(1.0, abs=0.06)
    # Noise of a quarter of the echo's power leaves 1 / 1.25^2 of the intensity's correlation.
    assert found.gain[:, noise > 0].mean() == pytest.approx(0.64, abs=0.08)
    assert found.gain[:, noise == 0].mean() == pytest.approx(1.0, abs=0.03)


def test_the_claimed_deviation_of_the_scale_is_not_a_boast():
    share = np.random.default_rng(1).choice([0.0, 0.2], len(PATCHES))
    ratios, claimed = zip(
        *[(r, f.scale_sigma) for f, r in (estimate(share, seed=s) for s in range(6))], strict=True
    )
    assert np.std(np.log(ratios)) < 3 * np.mean(claimed)


def test_the_kernel_finds_what_the_echo_model_says():
    curves = phantom_curves()
    amplitude = np.sqrt(curves.correlation)
    distance = np.linspace(0.05, 1.5, 60)
    c, gain = 0.35, 0.9
    left = np.exp(-distance / 8.0)
    rho = gain * (c * left + (1 - c) * field_correlation(distance)) ** 2
    out = np.empty((2, 2, 6))
    table = np.repeat(rho[:, None], 2, axis=1).astype(np.float32)
    fit_coherent_shares(
        table, distance, np.array([1.0, 1.4]), amplitude, 0.01, np.full(2, 80.0), 8.0, 1.0, 1.0, out
    )
    np.testing.assert_allclose(out[0, :, :2], [[c, gain]] * 2, atol=0.01)
    assert (out[0, :, 2] < out[1, :, 2]).all()
    assert (out[0, :, 2] < out[0, :, 4]).all()
    np.testing.assert_array_less(out[0, :, 4], out[0, :, 5])
