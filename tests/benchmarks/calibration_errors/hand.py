"""How a hand moves and how a sensor errs, for the trials of calibrations: smooth, and not white."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation


def smooth(rng: np.random.Generator, time_s: np.ndarray, reach: float) -> np.ndarray:
    """A signal of a few slow oscillations that fills -reach to reach: one way a hand moves to and fro."""
    phase = rng.uniform(0, 2 * np.pi, 4)
    hertz = np.exp(rng.uniform(np.log(0.03), np.log(0.5), 4))
    signal = (rng.uniform(0.4, 1.0, 4) * np.sin(2 * np.pi * hertz * time_s[:, None] + phase)).sum(axis=1)
    low, high = signal.min(), signal.max()
    return reach * (2.0 * (signal - low) / (high - low) - 1.0)


def wander(rng: np.random.Generator, time_s: np.ndarray, constant_s: float, components: int) -> np.ndarray:
    """An Ornstein-Uhlenbeck process of unit variance, shape (n, components)."""
    values = np.empty((len(time_s), components))
    values[0] = rng.standard_normal(components)
    kept = np.exp(-np.diff(time_s) / constant_s)
    for i, a in enumerate(kept):
        values[i + 1] = a * values[i] + np.sqrt(1.0 - a * a) * rng.standard_normal(components)
    return values


def misread(
    rng: np.random.Generator,
    poses: RigidTransform,
    time_s: np.ndarray,
    white: tuple[float, float] = (0.0, 0.0),
    drift: tuple[float, float, float] = (0.0, 0.0, 5.0),
) -> RigidTransform:
    """A tracker's readings: errors about the sensor in the world's axes, white and wandering.

    Parameters
    ----------
    white : (mm, degrees)
    drift : (mm, degrees, s)
        Per axis.
    """
    shift, turn = poses.as_components()
    moving = wander(rng, time_s, drift[2], 6)
    count = len(time_s)
    angles = np.deg2rad(drift[1] * moving[:, :3] + white[1] * rng.standard_normal((count, 3)))
    apart = drift[0] * moving[:, 3:] + white[0] * rng.standard_normal((count, 3))
    return RigidTransform.from_components(shift + apart, Rotation.from_rotvec(angles) * turn)
