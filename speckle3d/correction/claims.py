"""Claimed covariance of corrected poses: scatter of readings and errors of the sensors.

All covariances are of (x, y, z, tilt, yaw, roll) of every frame about the image's centre, against the first
frame and along its axes, mm and rad.
"""

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.geometry import skew
from speckle3d.correction.curves import CUBIC
from speckle3d.correction.settings import FusedSettings

LEAST_LENGTH_MM = float(np.finfo(float).eps)
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


def correlated_readings(error: FloatArray) -> float:
    """Autocorrelation time of the residuals of the curves, shape (m,), in readings.

    The coefficients make every autocovariance smaller by their number / m of the sum of all, which is put
    back.
    """
    error = error - error.mean()
    energy = total = float((error**2).sum())
    lags = 1
    while lags < len(error) // 4:
        product = float((error[lags:] * error[:-lags]).sum())
        if product <= 0.0:
            break
        total, lags = total + 2.0 * product, lags + 1
    bias = min((2 * lags - 1) * (CUBIC + 2) / len(error), 0.75) if lags > 1 else 0.0
    return max(total / max(energy, np.finfo(float).tiny) / (1.0 - bias), 1.0)


def curve_errors(error: FloatArray, has_reading: BoolArray) -> FloatArray:
    """Covariance of poses corrected by cubics, from the readings' residuals, shape (n, 6, 6).

    Steps corrected by cubics bend the path by polynomials of one degree more. Fitted to m readings of
    variance s2 these err at t, which is -1 to 1 from the first reading to the last, by s2 / m times the sum
    of (2 k + 1) P_k(t)^2 over Legendre's polynomials: more beyond the readings. What the curves leave beyond
    white jitter is an error of single frames.

    Parameters
    ----------
    error : ndarray, shape (m, 6)
        Readings less corrected poses, (x, y, z, tilt, yaw, roll), in the order of frames.
    has_reading : ndarray of bool, shape (n,)
        Frames with a reading, m in all.
    """
    order, readings = np.arange(CUBIC + 2), np.flatnonzero(has_reading)
    at = (2.0 * np.arange(has_reading.size) - readings[0] - readings[-1]) / np.ptp(readings)
    basis = legendre.legvander(at, CUBIC + 1) * np.sqrt(2.0 * order + 1.0)
    against_first = ((basis - basis[0]) ** 2).sum(axis=1) / len(error)
    runs = [correlated_readings(column) for column in error.T]
    white = np.mean((error[2:] - 2.0 * error[1:-1] + error[:-2]) ** 2, axis=0) / 6.0
    excess = 2.0 * np.maximum(error.var(axis=0) - white, 0.0)
    scatter = error.var(axis=0) * len(error) / max(len(error) - order.size, 1)
    variance = against_first[:, None] * scatter * runs
    variance[1:] += excess
    return np.asarray(variance[:, :, None] * np.eye(6))


def tracker_errors(
    poses: RigidTransform, centre_mm: FloatArray, time_s: FloatArray, errors: FusedSettings, wander_mm: float
) -> FloatArray:
    """Covariance by the errors of a tracker's scale, mounting and clock, and by its slow errors.

    Parameters
    ----------
    wander_mm : float
        Standard deviation of its places' slow errors along each axis; curves follow them.
    """
    from_first = poses[0].inv() * poses
    path, rotation = from_first.apply(centre_mm) - centre_mm, from_first.rotation.as_matrix() - np.eye(3)
    drift = np.gradient(path, time_s, axis=0)
    drift -= drift[0]
    across = skew(path)
    covariance = np.zeros((len(poses), 6, 6))
    covariance[:, :3, :3] = (
        errors.tracker_scale_sigma**2 * path[:, :, None] * path[:, None, :]
        + errors.clock_sigma_s**2 * drift[:, :, None] * drift[:, None, :]
        + errors.mounting_sigma_rad**2 * across @ across.transpose(0, 2, 1)
        + errors.mounting_sigma_mm**2 * rotation @ rotation.transpose(0, 2, 1)
        + wander_mm**2 * _growth(time_s, errors) * np.eye(3)
    )
    covariance[:, 3:, 3:] = errors.mounting_sigma_rad**2 * rotation @ rotation.transpose(0, 2, 1)
    return covariance


def orientation_errors(
    poses: RigidTransform, centre_mm: FloatArray, time_s: FloatArray, errors: FusedSettings
) -> FloatArray:
    """Covariance by an orientation sensor's slow errors, bending of the path included.

    Parameters
    ----------
    poses : RigidTransform, length n
        In the sensor's world, z up.
    """
    sigma = np.array([errors.inclination_sigma_rad, errors.inclination_sigma_rad, errors.heading_sigma_rad])
    to_first = poses[0].rotation.as_matrix().T
    slow = to_first @ np.diag(sigma**2) @ to_first.T
    path = (poses[0].inv() * poses).apply(centre_mm) - centre_mm
    # An angle that grows evenly along the way moves its end by half as much as one that is there throughout.
    lever = -0.5 * skew(path)
    slopes = np.concatenate([lever, np.broadcast_to(np.eye(3), lever.shape)], axis=1)
    return np.asarray(_growth(time_s, errors) * slopes @ slow @ slopes.transpose(0, 2, 1))


def _growth(time_s: FloatArray, errors: FusedSettings) -> FloatArray:
    """Variance of the change of a slow error of unit variance since the first frame, shape (n, 1, 1)."""
    return np.asarray(2.0 * (1.0 - np.exp((time_s[0] - time_s) / errors.wander_s)))[:, None, None]
