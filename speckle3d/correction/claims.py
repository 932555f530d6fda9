"""What modes claim: covariances of poses by the scatter of readings and by what is known of the sensors.

All covariances are of (x, y, z, tilt, yaw, roll) of every frame about the image's centre, against the first
frame and along its axes, mm and rad.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew
from speckle3d.correction.settings import FusedSettings

LEAST_LENGTH_MM = 1e-9
"""Of a sweep that did not move, whose relative error is as good as infinite."""


def length_sigma(poses: RigidTransform, covariance: FloatArray, centre_mm: FloatArray) -> float:
    """Relative standard deviation of a sweep's length: that of its farthest frame's elevation.

    Parameters
    ----------
    poses : RigidTransform, length n
    covariance : ndarray, shape (n, 6, 6)
    """
    z_mm = (poses[0].inv() * poses).apply(centre_mm)[:, 2]
    farthest = int(np.argmax(np.abs(z_mm)))
    return float(np.sqrt(covariance[farthest, 2, 2]) / max(abs(float(z_mm[farthest])), LEAST_LENGTH_MM))


def correlated_readings(error: FloatArray, shapes: int) -> float:
    """How many neighbouring readings err as one: the sum of their autocorrelation, at least one.

    Parameters
    ----------
    error : ndarray, shape (m, k)
        Residuals of a fit.
    shapes : int
        Slow shapes that the fit has taken out of each column: where it lies, its slope, its bend. These make
        every autocovariance smaller by `shapes` / m of the sum of all, which is put back.
    """
    error = error - error.mean(axis=0)
    m, energy = len(error), float((error**2).sum())
    total, lags = energy, 1
    while lags < m // 4:
        alike = float((error[lags:] * error[:-lags]).sum())
        if alike <= 0.0:
            break
        total, lags = total + 2.0 * alike, lags + 1
    lost = min((2 * lags - 1) * shapes / m, 0.75) if lags > 1 else 0.0
    return max(total / max(energy, np.finfo(float).tiny) / (1.0 - lost), 1.0)


def fitted_covariance(residuals: FloatArray, jacobian: FloatArray, frames: int, axes: int) -> FloatArray:
    """Covariance of coefficients fitted to readings, from how much the reading of each frame pulls.

    Parameters
    ----------
    residuals, jacobian : ndarray, shape (frames * k,) and (frames * k, axes * c)
        Of the fit; the first of each axis' c coefficients moves all frames alike.

    References
    ----------
    .. [1] P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", Proc. 5th
       Berkeley Symp., 1967 (the sandwich).
    """
    shapes = jacobian.shape[1] // axes
    pulls = np.einsum(
        "frc,fr->fc", *(each.reshape(frames, -1, *each.shape[1:]) for each in (jacobian, residuals))
    )
    alike = [
        correlated_readings(pulls[:, axis : axis + 1], shapes) for axis in range(0, axes * shapes, shapes)
    ]
    pulls *= np.sqrt(np.repeat(alike, shapes) * frames / max(frames - shapes, 1))
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    return np.asarray(inverse @ (pulls.T @ pulls) @ inverse)


def uncorrected_variance(error: FloatArray) -> FloatArray:
    """Variance between two frames of what curves leave of each axis beyond the readings' white jitter, (k,).

    Parameters
    ----------
    error : ndarray, shape (m, k)
        Readings less corrected poses, in the order of frames.
    """
    white = np.mean((error[2:] - 2.0 * error[1:-1] + error[:-2]) ** 2, axis=0) / 6.0
    return np.asarray(2.0 * np.maximum(error.var(axis=0) - white, 0.0), dtype=float)


def tracker_errors(
    poses: RigidTransform, centre_mm: FloatArray, time_s: FloatArray, known: FusedSettings
) -> FloatArray:
    """Covariance by a tracker's millimetres, mounting and clock, which none of its readings shows."""
    from_first = poses[0].inv() * poses
    path, turned = from_first.apply(centre_mm) - centre_mm, from_first.rotation.as_matrix() - np.eye(3)
    drift = np.gradient(path, time_s, axis=0)
    drift -= drift[0]
    across = skew(path)
    covariance = np.zeros((len(poses), 6, 6))
    covariance[:, :3, :3] = (
        known.tracker_scale_sigma**2 * path[:, :, None] * path[:, None, :]
        + known.clock_sigma_s**2 * drift[:, :, None] * drift[:, None, :]
        + known.mounting_sigma_rad**2 * across @ across.transpose(0, 2, 1)
        + known.mounting_sigma_mm**2 * turned @ turned.transpose(0, 2, 1)
    )
    covariance[:, 3:, 3:] = known.mounting_sigma_rad**2 * turned @ turned.transpose(0, 2, 1)
    return covariance


def orientation_errors(
    poses: RigidTransform, centre_mm: FloatArray, time_s: FloatArray, known: FusedSettings
) -> FloatArray:
    """Covariance by an orientation sensor's slow errors, which bend the path, too.

    Parameters
    ----------
    poses : RigidTransform, length n
        In the sensor's world, z up.
    """
    sigma = np.array([known.inclination_sigma_rad, known.inclination_sigma_rad, known.heading_sigma_rad])
    to_first = poses[0].rotation.as_matrix().T
    slow = to_first @ np.diag(sigma**2) @ to_first.T
    grown = 2.0 * (1.0 - np.exp(-(time_s - time_s[0]) / known.wander_s))
    path = (poses[0].inv() * poses).apply(centre_mm) - centre_mm
    # An angle that grows evenly along the way moves its end by half as much as one that is there throughout.
    bent = -0.5 * skew(path)
    errors = np.concatenate([bent, np.broadcast_to(np.eye(3), bent.shape)], axis=1)
    return np.asarray(grown[:, None, None] * errors @ slow @ errors.transpose(0, 2, 1))
