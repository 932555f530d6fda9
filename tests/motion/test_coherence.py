"""Coherent shares, noise, stretches and the scale of distances, from echoes made sample by sample."""

from dataclasses import replace

import numpy as np
import pytest
import speckle

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import ImageGrid
from speckle3d.motion.coherence import CoherenceSettings, estimate_coherence
from speckle3d.motion.patches import PatchSettings, lay_patches

GRID = ImageGrid(vectors=48, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID, PatchSettings())
LATERAL_MM = PATCHES.centre_mm[:, 0] - GRID.centre_mm[0]
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
    """What a phantom calibrates to: correlations of so few samples are biased there as they are in a sweep."""
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
    seen = np.abs(echo) ** 2
    seen = (seen - seen.mean(axis=1, keepdims=True)) / seen.std(axis=1, keepdims=True)
    return (seen[first] * seen[second]).mean(axis=1)


def sweep_table(path, share, noise, stretch, correlate, seed=0, steps=(1, 2, 3, 4, 6, 9, 12)):
    """Correlations of echoes drawn at every frame and patch; a table of pairs."""
    rng = np.random.default_rng(seed)
    frames = len(path)
    pairs = [(j - k, j) for j in range(frames) for k in steps if j >= k]
    first, second = np.array(pairs).T
    rho = []
    for p, lateral in enumerate(LATERAL_MM):
        position = path[:, 0] + path[:, 1] * lateral
        apart = np.abs(position[:, None] - position)
        moving = draws(rng, apart / stretch[p], field_correlation)
        staying = draws(rng, apart, structure_correlation)
        grain = draws(rng, apart, lambda d: 1.0 * (d == 0))
        echo = np.sqrt(share[p]) * staying + np.sqrt(1 - share[p]) * moving + np.sqrt(noise[p]) * grain
        rho.append(correlations(echo, first, second, correlate))
    return first, second, np.array(rho, dtype=np.float32).T


def made_path(frames=90, yaw_rad=0.0):
    """Uneven steps, and a turn about the depth axis there and back again."""
    steps = np.random.default_rng(9).uniform(0.05, 0.2, frames - 1)
    turn = yaw_rad * np.sin(np.linspace(0, 2 * np.pi, frames))
    return np.column_stack([np.cumsum(np.r_[0.0, steps]), turn])


def estimate(
    share=0.0, noise=0.0, stretch=1.0, start=1.0, seed=0, correlate="echo", yaw_rad=0.0, known=False, **settings
):
    path = made_path(yaw_rad=yaw_rad)
    each = (np.broadcast_to(values, len(PATCHES)) for values in (share, noise, stretch))
    found, rescaled = estimate_coherence(
        *sweep_table(path, *each, correlate, seed),
        start * path,
        phantom_curves(correlate),
        PATCHES,
        LATERAL_MM,
        CoherenceSettings(**settings),
        known,
    )
    return found, rescaled[-1, 0] / path[-1, 0], rescaled


def some(values, seed=1):
    return np.random.default_rng(seed).choice(values, len(PATCHES))


if __name__ == "__main__":
    for corr in ("echo", "intensity"):
        for kw in [dict(), dict(start=.55), dict(start=1.3), dict(seed=1), dict(seed=2), dict(yaw_rad=.02),
                   dict(share=some([0,.15,.4,.7])), dict(share=some([0,.15,.4,.7]), start=.55),
                   dict(noise=np.where(PATCHES.centre_mm[:,1]>30,.25,0)), dict(stretch=some([1,1.4])), dict(stretch=some([1,1.4]),start=.7), dict(stretch=1.4)]:
            f, r, _ = estimate(correlate=corr, **kw)
            print(corr, {k: v if np.ndim(v)==0 else '*' for k, v in kw.items()}, 'ratio %.4f sig %.4f' % (r, f.scale_sigma), 'share0 %.2f gain %.3f stretch1 %.2f' % ((f.share==0).mean(), f.gain.mean(), (f.stretch==1).mean()))
            for n in ('share','stretch'):
                if n in kw and np.ndim(kw[n]):
                    print('    ', n, [(v, round(float(getattr(f,n)[:,kw[n]==v].mean()),3)) for v in np.unique(kw[n])], 'share', [(v, round(float(f.share[:,kw[n]==v].mean()),3)) for v in np.unique(kw[n])])
